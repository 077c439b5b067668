"""The validation protocol on the synthetic lifts: every estimator, three kinds of folds.

Run from the project folder, in the background; it goes on where it was stopped::

    nice .venv/bin/python benchmarks/protocol.py --data ../shared/data/synthetic_lifts

Keypoints come from the cache of `benchmarks/monocular_lifts.py` where they are there. Nothing in
the product was chosen on the persons P07 and P08; rows say which persons they hold.
"""

from __future__ import annotations

import argparse
import platform
import resource
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd

TEST_PERSONS = ("P07", "P08")
COLUMNS = (
    "mean_mm", "sd_mm", "p95_mm", "mae_deg", "rmse_deg", "truth_mae_deg", "nearest_neighbour_mm",
    "fit_s", "predict_ms",
)  # fmt: skip


def prepare_cache(cache: Path, keypoints: Path) -> None:
    """Let the protocol find the keypoints that other benchmarks have made."""
    cache.mkdir(parents=True, exist_ok=True)
    place = cache / "keypoints"
    if keypoints.is_dir() and not place.exists():
        place.symlink_to(keypoints.resolve(), target_is_directory=True)


def run(options: argparse.Namespace, folds: str) -> tuple[Path, list[str]]:
    """Run one kind of folds through the command; return its folder and the command."""
    out = options.out / folds
    command = ["liftlens", "protocol", str(options.data), "--folds", folds, "--out", str(out),
               "--estimator", options.estimator, "--features", options.features,
               "--cache", str(options.cache)]  # fmt: skip
    if options.persons:
        command += ["--persons", options.persons]
    subprocess.run([sys.executable, "-m", "engine.cli_start", *command[1:]], check=True)
    return out, command


def summarise(out: Path, folds: str) -> str:
    """Return one row per method, for training and test persons apart, failing ones included."""
    methods = pd.read_csv(out / "tables" / "methods.csv").set_index("method")
    table1 = pd.read_csv(out / "tables" / "table1.csv")
    whole = table1[(table1["task"] == "all") & (table1["subject"] != "all")]
    is_test = whole["subject"].isin(TEST_PERSONS)
    for title, part in (("training persons", whole[~is_test]), ("test persons", whole[is_test])):
        methods[f"{title} mm"] = part.groupby("method")["mean_mm"].mean()
    groups = [c for c in ("training persons mm", "test persons mm") if c in methods]
    shown = methods[[*groups, *COLUMNS, "leak"]].round(2)
    persons = ", ".join(sorted(set(whole["subject"])))
    return f"Folds: {folds} (persons {persons})\n{shown.to_string()}"


def main() -> None:
    """Run the command for each kind of folds and write the summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data/synthetic_lifts"))
    parser.add_argument("--out", type=Path, default=Path(".benchmark_cache/protocol"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/protocol/cache"))
    parser.add_argument("--keypoints", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--folds", nargs="*", default=["trial", "random", "subject"])
    parser.add_argument("--estimator", default="all")
    parser.add_argument("--features", default="hog,hog+landmarks")
    parser.add_argument("--persons", help="for example P03,P08; all if left out")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/protocol.txt"))
    options = parser.parse_args()
    prepare_cache(options.cache, options.keypoints)
    parts = []
    for folds in options.folds:
        start = time.perf_counter()
        out, command = run(options, folds)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        parts.append(
            f"{summarise(out, folds)}\n{' '.join(command)}\n"
            f"{time.perf_counter() - start:.0f} s on the clock (less where folds were finished "
            f"already), {used.ru_utime + used.ru_stime:.0f} s of processor time of all runs so "
            f"far, at most {used.ru_maxrss / 1e6:.2f} GB"
        )
        head = (
            f"Validation protocol on the synthetic lifts; seed 0; {platform.machine()}, Python "
            f"{platform.python_version()}; python {' '.join(sys.argv)}\n"
            "Marker error in mm, angles in degrees against inverse kinematics of the measured "
            "markers (truth: against exact angles, other definitions). Synthetic data."
        )
        options.results.write_text("\n\n".join([head, *parts]) + "\n", encoding="utf-8")
        print(parts[-1], flush=True)


if __name__ == "__main__":
    main()
