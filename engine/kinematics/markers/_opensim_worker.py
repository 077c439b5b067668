"""Runs OpenSim's tools on set-up files, in a process of its own; needs `opensim` and nothing else.

    python _opensim_worker.py FOLDER STEP...

STEP is `scale` (FOLDER/scale.xml) or `ik` (FOLDER/ik.xml). OpenSim keeps global state and prints to
stdout whatever its log level, so that it never runs inside LiftLens.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path


def main(folder: Path, steps: list[str]) -> None:
    """Run the steps and leave `done.json` with the seconds each took."""
    os.chdir(folder)
    import opensim

    # The log of errors goes to stderr, which the parent keeps; no opensim.log in the folder.
    opensim.Logger.removeFileSink()
    opensim.Logger.setLevelString("Warn")
    took: dict[str, float] = {}
    for step in steps:
        start, used = time.perf_counter(), time.process_time()
        tool = {"scale": opensim.ScaleTool, "ik": opensim.InverseKinematicsTool}[step]
        if not tool(str(folder / f"{step}.xml")).run():
            raise RuntimeError(f"OpenSim's {step} tool reported a failure")
        took[step] = time.perf_counter() - start
        took[f"{step}_cpu"] = time.process_time() - used
    (folder / "done.json").write_text(json.dumps(took), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), sys.argv[2:])
