"""The `liftlens` command.

Exit codes: 0 done, 1 a fault of LiftLens, 2 wrong use, 3 unusable input, 4 a needed part is
missing, 130 cancelled. On failure the last line on stderr says what was expected, what came and
what to do.

Everything heavy is imported inside the commands, so that `--help` answers at once.
"""

from __future__ import annotations

import functools
import logging
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec

import typer

from engine.cli_library import build_app as build_library_app
from engine.cli_start import (
    CANCELLED_EXIT_CODE,
    guard_start,
    ignore_interrupts,
    release_start,
)

if TYPE_CHECKING:
    from rich.table import Table

    from engine.cli_calibrate import CalibrateRequest
    from engine.cli_settings import AssessSettings
    from engine.datatypes import ViewPose
    from engine.protocol import ProtocolRequest
    from engine.storage.library import Library

__all__ = ["app", "main"]

UNEXPECTED_EXIT_CODE = 1
REPORT_HINT = "run the same command with --debug and report what it prints."

app = typer.Typer(
    name="liftlens",
    help="Video of a person lifting becomes posture, joint angles and a lifting-risk assessment.",
    no_args_is_help=True,
    add_completion=False,
    # Plain text: an error's last line stays its sentence, not the border of a box.
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

P = ParamSpec("P")


def _number(text: str) -> float:
    """Return an option's number; say what is wrong with it as a person would."""
    try:
        return float(text)
    except ValueError:
        hint = f"; write {text.replace(',', '.')}, with a point" if "," in text else ""
        raise typer.BadParameter(f"expected a number, got {text!r}{hint}.") from None


def _number_option(description: str) -> Any:
    return typer.Option(parser=_number, metavar="NUMBER", help=description)


Debug = Annotated[
    bool, typer.Option("--debug", envvar="LIFTLENS_DEBUG", help="Show tracebacks and log messages.")
]
Quiet = Annotated[bool | None, typer.Option("--quiet", help="No progress on stderr.")]


def main() -> None:
    """Run the command line."""
    guard_start()
    app()


def _one_sentence(command: Callable[P, None]) -> Callable[P, None]:
    """Turn every failure of a command into its exit code and one sentence on stderr."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        is_debug = bool(kwargs.get("debug"))
        release_start()
        _set_up_logging(is_debug=is_debug)
        try:
            command(*args, **kwargs)
        except (typer.Exit, typer.Abort):
            raise
        except KeyboardInterrupt:
            _fail("Stopped; nothing was kept of what was unfinished.", CANCELLED_EXIT_CODE)
        except BrokenPipeError:
            # The reader (`| head`) has what it wanted; the interpreter must not flush again.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        except Exception as error:
            if is_debug:
                logging.getLogger("engine").exception("The command failed")
            _fail(*_explain(error))

    return run


def _explain(error: Exception) -> tuple[str, int]:
    """Return the sentence and the exit code for an error."""
    from engine.errors import EngineError

    if isinstance(error, EngineError):
        return str(error), error.exit_code
    if isinstance(error, MemoryError):
        return "LiftLens ran out of memory; close other programs or use a shorter part.", 3
    what = f"{type(error).__name__}: {error}"
    return f"LiftLens made a mistake ({what}); {REPORT_HINT}", UNEXPECTED_EXIT_CODE


def _fail(sentence: str, exit_code: int) -> None:
    if exit_code == CANCELLED_EXIT_CODE:
        ignore_interrupts()
    typer.echo("Error: " + " ".join(sentence.split()), err=True)
    raise typer.Exit(exit_code)


def _set_up_logging(*, is_debug: bool) -> None:
    logger = logging.getLogger("engine")
    if is_debug:
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, force=True)
    elif not logger.handlers:
        logger.addHandler(logging.NullHandler())


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        from engine.storage.document import find_version

        typer.echo(f"liftlens {find_version()}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit(2)


@app.command(no_args_is_help=False)
@_one_sentence
def assess(
    video: Annotated[Path, typer.Argument(help="The video.")],
    video2: Annotated[
        Path | None, typer.Argument(help="The same movement, filmed from another side.")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="File of the two cameras, from `liftlens calibrate` or another tool; without it "
            "they are calibrated from the moving person."
        ),
    ] = None,
    backend: Annotated[str | None, typer.Option(help="Estimator; see `liftlens backends`.")] = None,
    solver: Annotated[
        str | None,
        typer.Option(
            help="What turns keypoints into joint angles: geometric, least-squares or udeas."
        ),
    ] = None,
    stature: Annotated[
        float | None, _number_option("The person's stature in metres, for example 1.75.")
    ] = None,
    mass: Annotated[float | None, _number_option("The person's body mass in kg.")] = None,
    sex: Annotated[str | None, typer.Option(help="female or male.")] = None,
    age: Annotated[float | None, _number_option("The person's age in years.")] = None,
    load: Annotated[float | None, _number_option("What is lifted, in kg.")] = None,
    hands: Annotated[int | None, typer.Option(help="Hands on the load, 1 or 2.")] = None,
    coupling: Annotated[
        str | None, typer.Option(help="How well the hands hold the load: good, fair or poor.")
    ] = None,
    frequency: Annotated[float | None, _number_option("Lifts per minute.")] = None,
    duration: Annotated[float | None, _number_option("Hours of lifting in a row.")] = None,
    recovery: Annotated[
        float | None, _number_option("Hours of light work that follow the lifting.")
    ] = None,
    destination_control: Annotated[
        bool | None,
        typer.Option(
            "--destination-control/--no-destination-control",
            help="Whether the load must be set down with care.",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="TOML file with any of these settings; options win over it.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Result folder; by default ./liftlens_VIDEO.")
    ] = None,
    label: Annotated[
        str | None, typer.Option(help="Name of the trial; by default that of the video.")
    ] = None,
    correction: Annotated[
        str | None, typer.Option(help="How keypoints are cleaned: default, paper or none.")
    ] = None,
    fusion: Annotated[
        str | None, typer.Option(help="How two views are joined: model (default) or triangulate.")
    ] = None,
    sync: Annotated[
        str | None,
        typer.Option(
            help="auto, or the seconds to add to the times of the second video to get those of "
            "the first."
        ),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="File that the estimator reads, where it needs one.")
    ] = None,
    methods: Annotated[
        str | None, typer.Option(help="Risk methods, as A,B; see `liftlens methods`.")
    ] = None,
    start: Annotated[float | None, _number_option("Start of the part to assess, in s.")] = None,
    stop: Annotated[float | None, _number_option("End of the part to assess, in s.")] = None,
    box: Annotated[
        str | None,
        typer.Option(help="The person in the first frame, as LEFT,TOP,RIGHT,BOTTOM in px."),
    ] = None,
    lift: Annotated[
        list[str] | None,
        typer.Option(
            metavar="START,END",
            help="When a lift was, in s: only lifts named so count; repeatable.",
        ),
    ] = None,
    overlay: Annotated[
        bool | None, typer.Option("--overlay/--no-overlay", help="Write the annotated video.")
    ] = None,
    blur: Annotated[
        bool | None, typer.Option("--blur/--no-blur", help="Blur heads in the annotated video.")
    ] = None,
    surface: Annotated[
        bool | None,
        typer.Option(
            "--surface/--skeleton",
            help="Draw a body surface instead of the skeleton (needs the extra anny).",
        ),
    ] = None,
    quiet: Quiet = None,
    debug: Debug = False,
) -> None:
    """Assess a lift, filmed from one side or from two, and write a result folder.

    A configuration file has these tables: [person] stature_m, mass_kg, sex, age_y, label;
    [task] load_kg, hands, coupling, frequency_per_min, duration_h, recovery_h,
    destination_control, notes; [trial] label, site, job; [run] out, quiet; and one table per
    step: [video] start_s, stop_s; [subject] box; [pose] backend, variant, threads, model;
    [two_view] calibration, sync, fusion; [correction] preset; [kinematics] solver;
    [risk] methods; [output] overlay, blur_heads, surface. [corrections] lifts = [[2.1, 3.4]] says
    when the lifts were, where they were not found as they happened.
    """
    from engine.cli_settings import OPTION_KEYS, build_settings

    given = locals()
    settings = build_settings(
        video,
        second_video=video2,
        config_path=config,
        options={name: given[name] for name in OPTION_KEYS},
    )
    _assess(settings)


def _assess(settings: AssessSettings) -> None:
    from engine.cli_output import summarise
    from engine.storage.results import check_target, read_result

    target = check_target(settings.out)
    folder = _run_pipeline(settings, target)
    typer.echo(summarise(read_result(folder)))
    typer.echo(f"\nResult: {folder}")


def _run_pipeline(settings: AssessSettings, folder: Path) -> Path:
    from engine.cli_output import show_progress, stop_on_signal

    with show_progress(is_quiet=settings.is_quiet) as shown:
        shown("start", 0, 0)
        # It takes seconds, and Ctrl-C may interrupt it at any moment: nothing is written yet.
        from engine.pipeline import assess_to_folder

        corrected = {"corrections": settings.corrections} if settings.corrections.all else {}
        with stop_on_signal(shown) as progress:
            return assess_to_folder(settings.trial, settings.config, folder, progress, **corrected)


@app.command(short_help="Assess the samples and open the dashboard.")
@_one_sentence
def demo(
    serve: Annotated[
        bool, typer.Option("--serve/--no-serve", help="Open the dashboard afterwards.")
    ] = True,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the dashboard.")] = 8501,
    host: Annotated[str, typer.Option(help="Address the dashboard listens on.")] = "localhost",
    quiet: Quiet = None,
    debug: Debug = False,
) -> None:
    """Assess the bundled samples into the library and open the dashboard."""
    from engine.cli_demo import read_samples
    from engine.storage.library import Library

    samples = read_samples()
    library = Library.open()
    for number, sample in enumerate(samples, start=1):
        if not _is_assessed(library, sample.trial_id):
            if not quiet:
                typer.echo(f"Sample {number} of {len(samples)}: {sample.title}", err=True)
            _run_pipeline(sample.settings(is_quiet=bool(quiet)), library.folder(sample.trial_id))
    typer.echo(_list_samples(library, [sample.trial_id for sample in samples]))
    typer.echo(f"\nLibrary: {library.root}")
    if serve:
        _serve(host=host, port=port)


def _is_assessed(library: Library, trial_id: str) -> bool:
    """Whether a readable result is there; a damaged one is deleted."""
    from engine.errors import DataError
    from engine.storage.results import read_result

    if not library.has(trial_id):
        return False
    try:
        read_result(library.folder(trial_id))
    except DataError:
        library.delete(trial_id)
        return False
    return True


def _list_samples(library: Library, trial_ids: list[str]) -> str:
    from engine.cli_output import format_columns, format_index
    from engine.storage.results import read_result

    levels = {entry.id: entry.worst_level for entry in library.entries()}
    rows: list[tuple[str, ...]] = []
    for trial_id in trial_ids:
        stored = read_result(library.folder(trial_id))
        rnle = stored.risk.get("rnle")
        times = [f"{lift.start_s:.2f}-{lift.end_s:.2f}" for lift in stored.lifts]
        level = levels.get(trial_id)
        rows.append(
            (
                stored.document["label"],
                ", ".join(times) or "none",
                "-" if rnle is None else format_index(rnle.value, rnle.interval),
                "-" if level is None else level.value,
            )
        )
    titles = ("Sample", "Lifts (s)", "Lifting index (about 95 %)", "Flag")
    return "\n".join(format_columns(titles, rows))


@app.command(short_help="List the estimators and their licences.")
@_one_sentence
def backends(debug: Debug = False) -> None:
    """List the estimators, their licences and what is missing to use them."""
    from engine.pose.base import list_backends

    table = _make_table("Name", "Title", "Licence", "Available")
    for info in list_backends():
        missing = f"missing: {', '.join(info.missing)}; run: {info.install_hint}"
        table.add_row(info.name, info.title, info.licence, missing if info.missing else "yes")
    _print_table(table, empty="No estimator is installed.")


@app.command(short_help="List the risk methods and their sources.")
@_one_sentence
def methods(debug: Debug = False) -> None:
    """List the risk methods, their sources and whether they run by default."""
    from engine.ergonomics.base import list_methods

    table = _make_table("Name", "Title", "Available", "Reference")
    for method in list_methods():
        info = method.info
        switch = "experimental: set risk.experimental = true"
        table.add_row(
            info.name, info.title, switch if info.is_experimental else "yes", info.reference
        )
    _print_table(table, empty="No risk method is installed.")


def _make_table(*columns: str) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _print_table(table: Table, *, empty: str) -> None:
    from rich.console import Console

    if not table.row_count:
        typer.echo(empty)
        return
    # A file or a pipe has no width: don't fold names at the 80 columns rich assumes.
    Console(width=None if sys.stdout.isatty() else 160, markup=False).print(table)


@app.command()
@_one_sentence
def export(
    result_dir: Annotated[Path, typer.Argument(help="A result folder.")],
    format_: Annotated[str, typer.Option("--format", help="trc, mot, c3d, csv or bvh.")],
    out: Annotated[
        Path | None, typer.Option(help="File or folder; by default a file in this folder.")
    ] = None,
    debug: Debug = False,
) -> None:
    """Write a result in the format of another tool."""
    from engine.storage.exports import export_result

    typer.echo(f"Written: {export_result(result_dir, format_, out)}")


@app.command(short_help="Compare results with reference recordings.")
@_one_sentence
def validate(
    result_dirs: Annotated[
        list[Path], typer.Argument(metavar="RESULT_DIR...", help="One or more result folders.")
    ],
    reference: Annotated[
        list[Path],
        typer.Option(help="TRC, C3D, MOT, STO or CSV file; once per result, in the same order."),
    ],
    profile: Annotated[
        Path | None, typer.Option(help="Import profile (TOML): what the recordings mean.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write; by default RESULT_DIR_agreement.")
    ] = None,
    offset: Annotated[
        str,
        typer.Option(
            help="Constant differences: remove, keep, or auto (remove for recorded angles)."
        ),
    ] = "auto",
    max_lag: Annotated[
        float | None, _number_option("Largest shift in time to try, in s; by default any.")
    ] = None,
    save_profile: Annotated[
        Path | None, typer.Option(help="Write what was detected as an import profile.")
    ] = None,
    quiet: Quiet = None,
    debug: Debug = False,
) -> None:
    """Compare results with reference recordings, such as those of a motion laboratory.

    Writes agreement.json, tables (CSV), figures (PNG) and a one-page summary (HTML). Several
    results are pooled by person and by task (the job named when the video was assessed).
    """
    from engine.cli_validate import ValidateRequest, run_validate

    request = ValidateRequest(
        results=tuple(result_dirs),
        references=tuple(reference),
        profile=profile,
        out=out,
        offset=offset,
        max_lag_s=max_lag,
        save_profile=save_profile,
        is_quiet=bool(quiet),
    )
    run_validate(request, say=typer.echo, warn=lambda line: typer.echo(line, err=True))


@app.command(short_help="Run the validation protocol on a data set with markers.")
@_one_sentence
def protocol(
    dataset: Annotated[Path, typer.Argument(help="Folder of the data set; see docs/datasets.md.")],
    out: Annotated[Path, typer.Option(help="Folder of the study; an earlier run is taken up.")],
    estimator: Annotated[
        str,
        typer.Option(
            help="nn, wknn, ridge, gp, gp-smooth, tgp, tgp-knn, tgp-constrained, "
            "tgp-constrained-gh; several by commas, or all."
        ),
    ] = "tgp-constrained",
    features: Annotated[
        str,
        typer.Option(
            help="hog, hog-soft, hog-paper, landmarks, landmarks-window, hog+landmarks; several by "
            "commas, or all."
        ),
    ] = "hog",
    folds: Annotated[
        str,
        typer.Option(
            help="trial (repetition-wise), block, random (leaky, for comparison with papers) or "
            "subject (leave one out)."
        ),
    ] = "trial",
    n_folds: Annotated[int, typer.Option(help="Partitions of trial, block and random folds.")] = 4,
    persons: Annotated[str | None, typer.Option(help="As P03,P08; by default all.")] = None,
    views: Annotated[str, typer.Option(help="2, or the first or second alone.")] = "2",
    train_repetitions: Annotated[
        int | None,
        typer.Option(help="Learn from at most so many repetitions of each task (trial folds)."),
    ] = None,
    ik: Annotated[
        str, typer.Option(help="Inverse kinematics: builtin, or opensim where it is installed.")
    ] = "builtin",
    seed: Annotated[int, typer.Option(help="Of random folds.")] = 0,
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder for features, to share between runs; by default OUT/cache."),
    ] = None,
    skip_unusable: Annotated[
        bool, typer.Option("--skip-unusable", help="Leave trials out that can't be used.")
    ] = False,
    quiet: Quiet = None,
    debug: Debug = False,
) -> None:
    """Train and judge estimators on lifts with markers; write tables, figures and a report.

    Reproduces the tables and figures of the two-view lifting paper on any data set of its kind.
    A run that was stopped goes on with the same command.
    """
    from engine.cli_protocol import build_request

    request = build_request(
        dataset,
        out,
        estimator=estimator,
        features=features,
        folds=folds,
        persons=persons,
        views=views,
        n_folds=n_folds,
        train_repetitions=train_repetitions,
        ik=ik,
        seed=seed,
        cache=cache,
        skip_unusable=skip_unusable,
    )
    _run_study(request, is_quiet=bool(quiet))


def _run_study(request: ProtocolRequest, *, is_quiet: bool) -> None:
    from engine.cli_output import show_progress, stop_on_signal
    from engine.cli_protocol import run_study
    from engine.config import Config
    from engine.datatypes import ProgressCallback, View

    def observe(view: View, progress: ProgressCallback) -> ViewPose:
        from engine.pipeline import estimate_view

        return estimate_view(view, Config(), progress)

    lines: list[str] = []
    with show_progress(is_quiet=is_quiet) as shown, stop_on_signal(shown) as progress:
        run_study(request, observe=observe, progress=progress, say=lines.append)
    typer.echo("\n".join(lines))


@app.command(short_help="Find out where two cameras stand.")
@_one_sentence
def calibrate(
    videos: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[VIDEO VIDEO2]", help="Two videos, or two folders of photographs."),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="board (a printed board), points (clicked points of known size) or person "
            "(somebody who moves)."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The calibration file to write (.toml).")] = None,
    board: Annotated[str, typer.Option(help="charuco or checkerboard.")] = "charuco",
    columns: Annotated[int | None, typer.Option(help="Squares of the board across.")] = None,
    rows: Annotated[int | None, typer.Option(help="Squares of the board down.")] = None,
    square_mm: Annotated[float | None, _number_option("Side of a square, mm.")] = None,
    marker_mm: Annotated[float | None, _number_option("Side of a marker, mm (charuco).")] = None,
    dictionary: Annotated[str | None, typer.Option(help="Marker dictionary (charuco).")] = None,
    floor_at: Annotated[
        float | None, _number_option("Second of the first video at which the board lies flat.")
    ] = None,
    sync: Annotated[str, typer.Option(help="auto, or seconds between the videos.")] = "auto",
    lenses: Annotated[
        Path | None, typer.Option(help="Calibration file that the lenses are taken from.")
    ] = None,
    points: Annotated[Path | None, typer.Option(help="TOML file of clicked points.")] = None,
    stature: Annotated[float | None, _number_option("The person's stature in metres.")] = None,
    check: Annotated[
        Path | None, typer.Option(help="Check this calibration; with videos, against the person.")
    ] = None,
    convert: Annotated[
        Path | None, typer.Option(help="Write another program's calibration as LiftLens's own.")
    ] = None,
    print_board: Annotated[
        Path | None, typer.Option(help="Draw a board to print (.png, .svg or .pdf).")
    ] = None,
    paper: Annotated[str, typer.Option(help="Paper of the board: a4, a3 or letter.")] = "a3",
    quiet: Quiet = None,
    debug: Debug = False,
) -> None:
    """Calibrate two cameras, or check, convert or print what belongs to it.

    Exactly one of --method, --check, --convert and --print-board says what to do.
    """
    from engine.cli_calibrate import CalibrateRequest

    request = CalibrateRequest(
        videos=tuple(videos or ()),
        method=method,
        out=out,
        board=board,
        columns=columns,
        rows=rows,
        square_mm=square_mm,
        marker_mm=marker_mm,
        dictionary=dictionary,
        floor_at_s=floor_at,
        sync=sync,
        lenses=lenses,
        points=points,
        stature_m=stature,
        check=check,
        convert=convert,
        print_board=print_board,
        paper=paper,
    )
    _calibrate(request, is_quiet=bool(quiet))


def _calibrate(request: CalibrateRequest, *, is_quiet: bool) -> None:
    from engine.cli_calibrate import run_calibrate
    from engine.cli_output import show_progress, stop_on_signal
    from engine.config import Config, TwoViewConfig
    from engine.datatypes import View

    lines: list[str] = []
    try:
        with (
            show_progress(is_quiet=is_quiet or request.print_board is not None) as shown,
            stop_on_signal(shown) as progress,
        ):

            def observe(videos: Sequence[Path]) -> Sequence[ViewPose]:
                from engine.pipeline import observe_views

                config = Config(two_view=TwoViewConfig(sync=request.sync))
                return observe_views([View(video) for video in videos], config, progress)

            run_calibrate(
                request, observe=observe, progress=progress, say=lines.append, warn=lines.append
            )
    finally:
        # What was found is said even when it is then refused.
        if lines:
            typer.echo("\n".join(lines))


@app.command(short_help="Compare the form of two performances.")
@_one_sentence
def compare(
    reference: Annotated[Path, typer.Argument(help="Result folder of the reference performance.")],
    attempt: Annotated[Path, typer.Argument(help="Result folder of the attempt.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the table, the figure and JSON; by default none."),
    ] = None,
    reference_repetition: Annotated[
        int, typer.Option(help="Which repetition of the reference, from 1.")
    ] = 1,
    attempt_repetition: Annotated[
        int | None, typer.Option(help="Which repetition of the attempt; by default all.")
    ] = None,
    quiet: Quiet = None,
    debug: Debug = False,
) -> None:
    """Compare two performances of one movement, phase by phase, whatever their speed."""
    from engine.cli_compare import CompareRequest, run_compare

    request = CompareRequest(
        reference=reference,
        attempt=attempt,
        out=out,
        reference_repetition=reference_repetition,
        attempt_repetition=attempt_repetition,
        is_quiet=bool(quiet),
    )
    run_compare(request, say=typer.echo, warn=lambda line: typer.echo(line, err=True))


@app.command(short_help="Write a trial or a job as a PDF.")
@_one_sentence
def report(
    result_dirs: Annotated[
        list[Path], typer.Argument(metavar="RESULT_DIR...", help="One or more result folders.")
    ],
    out: Annotated[Path, typer.Option(help="The PDF to write.")],
    before: Annotated[
        list[Path] | None,
        typer.Option(help="Result from before a change of the work, to compare with; repeatable."),
    ] = None,
    paper: Annotated[str, typer.Option(help="a4 or letter.")] = "a4",
    language: Annotated[str, typer.Option(help="Language of the labels: en.")] = "en",
    title: Annotated[str, typer.Option(help="In the place of the trial's or job's name.")] = "",
    anonymous: Annotated[
        bool, typer.Option("--anonymous", help="Leave out pseudonyms, names and pictures.")
    ] = False,
    file_names: Annotated[bool, typer.Option("--file-names", help="Name the video files.")] = False,
    debug: Debug = False,
) -> None:
    """Write a PDF: one page for one result, a summary for several of a job or department."""
    from engine.cli_report import ReportRequest, run_report
    from engine.report import ReportOptions

    options = ReportOptions(
        paper=paper,
        language=language,
        title=title,
        is_anonymous=anonymous,
        with_file_names=file_names,
    )
    request = ReportRequest(tuple(result_dirs), out, tuple(before or ()), options)
    run_report(request, say=typer.echo)


app.add_typer(build_library_app(_one_sentence), name="library")


@app.command()
@_one_sentence
def serve(
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen on.")] = 8501,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "localhost",
    debug: Debug = False,
) -> None:
    """Open the dashboard in a browser; Ctrl-C ends it."""
    _serve(host=host, port=port)


def _serve(*, host: str, port: int) -> None:
    from engine.cli_serve import serve_dashboard

    exit_code = serve_dashboard(host=host, port=port, say=typer.echo)
    if exit_code:
        raise typer.Exit(exit_code)


if __name__ == "__main__":
    main()
