"""How quick the library stays with ten thousand trials.

Run from the project folder::

    .venv/bin/python benchmarks/library.py

Makes a library of synthetic trials in a folder of its own (kept in ``.benchmark_cache`` for the
next run; ``--fresh`` makes it anew), then times what pages and workers do, each several times. Give
``--url`` for PostgreSQL. Every trial has a whole document and small curves, so that reading
folders costs what it costs.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import shutil
import statistics
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # the synthetic results are those of the tests

from engine.datatypes import FlagLevel  # noqa: E402
from engine.storage.database.connection import URL_VARIABLE, close_databases  # noqa: E402
from engine.storage.library import Library  # noqa: E402
from engine.storage.results import write_result  # noqa: E402
from tests.builders import make_flag, make_lift, make_trial_result  # noqa: E402

LEVELS = (FlagLevel.OK, FlagLevel.REVIEW, FlagLevel.HIGH)
START = datetime(2025, 1, 1, tzinfo=UTC)
PAGE = 25


def make_folders(root: Path, n_trials: int, seed: int) -> None:
    """Write the result folders as an older program without a database left them."""
    rng = random.Random(seed)
    pattern = root.parent / "pattern"
    flags = tuple(make_flag(level, lift_index=i) for i, level in enumerate(LEVELS))
    lifts = tuple(make_lift(0.2 + i, 0.8 + i) for i in range(3))
    write_result(make_trial_result(n_frames=30, lifts=lifts, flags=flags), pattern)
    document = json.loads((pattern / "trial.json").read_text(encoding="utf-8"))
    (root / "trials").mkdir(parents=True)
    for number in range(n_trials):
        made = START + timedelta(minutes=60 * number + rng.randint(0, 59))
        folder = root / "trials" / f"{made:%Y%m%d-%H%M%S}-{number:06d}"
        folder.mkdir()
        document |= {
            "created": made.isoformat(timespec="seconds"),
            "label": f"{rng.choice(('Crate', 'Sack', 'Barrel', 'Tyre'))} {number}",
            "site": f"Hall {rng.randint(1, 12)}",
            "job": f"Job {rng.randint(1, 40)}",
        }
        document["subject"]["label"] = f"P{rng.randint(1, 300):03d}"
        document["risk"]["rnle"]["value"] = round(rng.lognormvariate(0.2, 0.6), 2)
        for flag in document["flags"]:
            flag["level"] = rng.choice(LEVELS).value
        (folder / "trial.json").write_text(json.dumps(document), encoding="utf-8")
        shutil.copy(pattern / "tracks.npz", folder / "tracks.npz")
    shutil.rmtree(pattern)


def time_call(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return median and worst time in milliseconds."""
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        spent.append(1000 * (time.perf_counter() - start))
    return statistics.median(spent), max(spent)


def reopen(root: Path) -> Library:
    """Open as a new process does: no connection, nothing remembered of the folders."""
    close_databases()
    library = Library.open(root)
    library.query(limit=PAGE)
    return library


def measure(root: Path, repeats: int) -> list[tuple[str, float, float]]:
    """Time everything pages and workers do."""
    rows = []

    def add(what: str, call: Callable[[], object], times: int = repeats) -> None:
        rows.append((what, *time_call(call, times)))

    add("open in a new process, with the first page", lambda: reopen(root), 3)
    add("open again", lambda: Library.open(root))
    library = Library.open(root)
    time.sleep(2.5)  # until the folder's time can be trusted
    library.query(limit=PAGE)
    add(f"first page of {PAGE}, with counts", lambda: library.query(limit=PAGE))
    add("last page", lambda: library.query(limit=PAGE, order="oldest"))
    add("search two words", lambda: library.query(search="crate hall", limit=PAGE))
    add(
        "filter by site, person and level",
        lambda: library.query(site="Hall 3", person="P007", level=FlagLevel.HIGH, limit=PAGE),
    )
    add("highest lifting index first", lambda: library.query(order="index", limit=PAGE))
    add("choices of the filters", library.choices)
    add("overview by site, job and month", library.overview)
    add("all entries at once", library.entries, 3)
    names = [entry.id for entry in library.query(limit=repeats).entries]
    add("add a note", lambda: library.add_note(names[0], "seen"))
    spare = root.parent / "spare"
    added: list[str] = []

    def adopt() -> None:
        shutil.copytree(library.folder(names[0]), spare)
        added.append(library.adopt(spare))

    add("adopt a result (its copy included)", adopt)
    add("first page after a new trial", lambda: (adopt(), library.query(limit=PAGE)))
    add("delete a trial, to the last byte", lambda: library.delete(added.pop()))
    while added:
        library.delete(added.pop())
    return rows


def main() -> None:
    """Make or reuse the library, time it, print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--seed", type=int, default=20261122)
    parser.add_argument("--url", help="a PostgreSQL database of its own; SQLite if not given")
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/library"))
    parser.add_argument("--fresh", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/library.txt"))
    given = parser.parse_args()
    os.environ.pop(URL_VARIABLE, None)
    if given.url:
        os.environ[URL_VARIABLE] = given.url
    root = (given.cache / f"{given.trials}").resolve()
    if given.fresh:
        shutil.rmtree(root, ignore_errors=True)
    if not root.exists():
        make_folders(root, given.trials, given.seed)
    how = "from the database" if (root / "library.db").exists() else "every one read into a row"
    start = time.perf_counter()
    n_trials = Library.open(root).query(limit=1).total
    taken_over_s = time.perf_counter() - start
    rows = measure(root, given.repeats)
    kind = "PostgreSQL" if given.url else "SQLite"
    machine = f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    lines = [
        f"Library of {n_trials} trials on {kind}, seed {given.seed}, median of {given.repeats}",
        f"Command: benchmarks/library.py --trials {given.trials} --repeats {given.repeats}",
        f"Machine: {machine}, load {os.getloadavg()[0]:.1f}",
        "",
        f"{'first look at the folders':<50}{taken_over_s:10.2f} s ({how})",
        "",
        f"{'':<50}{'median':>10}{'worst':>10}  (ms)",
        *(f"{what:<50}{median:10.1f}{worst:10.1f}" for what, median, worst in rows),
    ]
    text = "\n".join(lines) + "\n"
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
