"""A worker whose work is told by the words in the "video": a real process without a model."""

import sys
import time
from pathlib import Path

from engine.errors import NoPersonFound
from engine.jobs.worker import main
from engine.storage.results import write_result
from tests.builders import make_trial_result


def assess(trial, config, folder: Path, progress) -> Path:
    words = trial.views[0].path.read_text().split()
    order = folder.parents[2] / "order.txt"
    with order.open("a") as file:
        file.write(f"{trial.label}\n")
    if "hang" in words:  # never looks whether it should stop
        progress("pose", 1, 2)
        time.sleep(60)
    if "fail" in words:
        raise NoPersonFound("No person was found in clip.mp4; film the whole body.")
    if "bug" in words:
        raise KeyError("left_toe")
    for done in range(600 if "slow" in words else 2):
        progress("pose", done, 600)
        time.sleep(0.02)
    return write_result(make_trial_result(trial=trial), folder)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], assess=assess, command=(sys.executable, __file__)))
