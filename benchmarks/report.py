"""How long reports take and how large they are: one trial's page, and a summary of twenty.

The bundled clips are assessed once (kept in `.benchmark_cache/report`, about 20 s each); the
trials of the summary are copies of them at other dates. Timed are reading the results and
rendering, in a process that is already running (the dashboard) and as the whole command in a new
one. Processor time is given beside the clock's, since other programs don't lengthen it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from engine.cli_demo import read_samples  # noqa: E402
from engine.pipeline import assess_to_folder  # noqa: E402
from engine.report import ReportOptions, render_job_report, render_trial_report  # noqa: E402
from engine.report.sheet import PAPERS  # noqa: E402
from engine.storage.results import read_result  # noqa: E402

CACHE = ROOT / ".benchmark_cache" / "report"
N_TRIALS = 20
PAGE_LIMIT_S, SIZE_LIMIT = 2.0, 1_000_000


def assess_samples() -> list[Path]:
    """Assess every bundled clip of one view, unless that was done before."""
    folders = []
    for sample in read_samples():
        if sample.second_video is not None:
            continue
        folder = CACHE / sample.key
        if not (folder / "trial.json").is_file():
            settings = sample.settings(is_quiet=True)
            assess_to_folder(settings.trial, settings.config, folder)
        folders.append(folder)
    return folders


def make_trials(sources: list[Path], scratch: Path) -> list[Path]:
    """Copy results to other dates and jobs."""
    folders = []
    for number in range(N_TRIALS):
        folder = scratch / f"trial_{number:02d}"
        shutil.copytree(sources[number % len(sources)], folder)
        path = folder / "trial.json"
        document = json.loads(path.read_text())
        document["created"] = f"2026-{1 + number % 12:02d}-{1 + number:02d}T09:00:00+00:00"
        document["job"] = ("Packing", "Palletising")[number % 2]
        path.write_text(json.dumps(document))
        folders.append(folder)
    return folders


def time_best(work: Callable[[], bytes], repeats: int) -> tuple[float, float, bytes]:
    """Return the least seconds by clock and processor, and what was made."""
    runs = []
    for _ in range(repeats):
        clock, cpu = time.perf_counter(), time.process_time()
        made = work()
        runs.append((time.perf_counter() - clock, time.process_time() - cpu))
    return min(r[0] for r in runs), min(r[1] for r in runs), made


def time_command(folders: list[Path], out: Path, repeats: int) -> tuple[float, float, bytes]:
    """Return the same of the whole command in a new process."""
    code = "from engine.cli_start import main; main()"
    command = [sys.executable, "-c", code, "report", *map(str, folders), "--out", str(out)]

    def cpu_of_children() -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    runs = []
    for _ in range(repeats):
        clock, cpu = time.perf_counter(), cpu_of_children()
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        runs.append((time.perf_counter() - clock, cpu_of_children() - cpu))
    return min(r[0] for r in runs), min(r[1] for r in runs), out.read_bytes()


def measure(repeats: int) -> list[tuple[str, tuple[float, float, bytes], float]]:
    """Return what was made, its times and bytes, and the limit in seconds (0 for none)."""
    sources = assess_samples()
    rows = []
    with tempfile.TemporaryDirectory() as name:
        trials = make_trials(sources, Path(name))
        render_trial_report(read_result(sources[0]))  # fonts and modules are loaded once
        for source in sources:
            for paper in PAPERS:
                options = ReportOptions(paper=paper)
                run = time_best(
                    lambda s=source, o=options: render_trial_report(read_result(s), o), repeats
                )
                rows.append((f"page, {source.name}, {paper}", run, PAGE_LIMIT_S))
        run = time_best(lambda: render_job_report([read_result(f) for f in trials]), repeats)
        rows.append((f"summary of {N_TRIALS} trials", run, 0.0))
        out = Path(name) / "report.pdf"
        rows.append(("command, one trial", time_command(sources[:1], out, repeats), PAGE_LIMIT_S))
        rows.append((f"command, {N_TRIALS} trials", time_command(trials, out, repeats), 0.0))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    rows = measure(options.repeats)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    lines = [
        f"# python benchmarks/report.py --repeats {options.repeats} (nothing is random)",
        f"# {machine}; one thread; best of {options.repeats}",
        f"{'what':<38}{'clock s':>9}{'cpu s':>8}{'kB':>8}{'limit s':>9}",
    ]
    for what, (clock, cpu, pdf), limit in rows:
        is_kept = len(pdf) < SIZE_LIMIT and (not limit or clock <= limit)
        shown = f"{limit:.1f}" if limit else "-"
        row = f"{what:<38}{clock:>9.2f}{cpu:>8.2f}{len(pdf) / 1e3:>8.0f}{shown:>9}"
        lines.append(f"{row}  {'ok' if is_kept else 'MISSED'}")
    text = "\n".join(lines) + "\n"
    print(text)
    (ROOT / "benchmarks" / "results" / "report.txt").write_text(text)


if __name__ == "__main__":
    main()
