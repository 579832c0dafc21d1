"""Commands that read logs."""

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from risaf_link.cli.options import Span, configured, progress_over, selected, spread
from risaf_link.errors import ConfigError, LogError

if TYPE_CHECKING:
    from risaf_link.config import Config
    from risaf_link.core.estimate import EstimateBlock
    from risaf_link.replay import Replay, Selection
    from risaf_link.report import LookBack

Sink = Callable[["EstimateBlock"], None]


@click.command()
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path))
@configured
@click.option(
    "--speed",
    type=click.FloatRange(min=0, min_open=True),
    metavar="N",
    help="Times real time, of one log.  [default: as fast as it goes]",
)
@selected
@click.option(
    "--outage",
    "outages",
    type=Span(),
    multiple=True,
    help="Withhold GPS from A to B seconds after the first sample, and score the heading "
    "against it. Repeatable.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="OUT.tlog",
    help="Write what the service would have sent, of one log.",
)
@click.option(
    "--csv",
    type=click.Path(path_type=Path),
    metavar="OUT.csv|DIR",
    help="Write one row an epoch; rad, rad/s. Of many logs: one file each into a directory.",
)
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    metavar="OUT.png",
    help="Draw heading and error of one log (needs the extra `plot`).",
)
@click.option(
    "--report",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write report.html on one log: words, tables, pictures (needs the extra `plot`).",
)
@click.option(
    "--mcap",
    type=click.Path(path_type=Path),
    metavar="OUT.mcap",
    help="Write one log's estimates for Foxglove or PlotJuggler (needs the extra `mcap`).",
)
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print the summary as one JSON object; of many logs, a list of them.",
)
@spread
def replay(
    logs: tuple[Path, ...], config_path: Path | None, settings: tuple[str, ...], **options: Any
) -> None:
    """Send tlogs through the pipeline and score their heading.

    Outages of GPS that the log has are found; more can be made with --outage. Headings are scored
    against the truth where the log carries it (SITL, simulate), and against GPS that was withheld.

    Many logs (or one with --workers or --cluster) are spread over all cores, or over the workers of
    a cluster, which need the same files at the same paths. One that cannot be used says why in its
    row; the others go on, and the exit status is 3. A CSV bears the name of its log, with as many
    directories before it as tell it from the others. With --csv, what was finished when it was
    interrupted is not done again, unless log, options, configuration or program have changed.

    \b
    risaf-link replay drive.tlog --out estimate.tlog --csv estimate.csv
    risaf-link replay drive.tlog --outage 100:300 --set fusion.method=mean --json
    risaf-link replay drive.tlog --report drive --mcap drive.mcap
    risaf-link replay night/*/*.tlog --csv tables --cluster tcp://10.0.0.1:8786
    """
    from risaf_link.kept import chosen_by, load_for_replay
    from risaf_link.replay import Selection

    config = load_for_replay(config_path, settings)
    span = options["start"], options["end"], options["outages"]
    selection = Selection(*span, chosen_by(settings))
    if len(logs) > 1 or options["workers"] or options["cluster"]:
        _replay_all(logs, config, selection, options)
    else:
        _replay_one(logs[0], config, selection, options)


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@configured
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    metavar="OUT.png",
    help="Draw how often each message came over time (needs the extra `plot`).",
)
def inspect(
    log: Path, config_path: Path | None, settings: tuple[str, ...], plot: Path | None
) -> None:
    """Tell what is in a log, and what the service could do with it.

    \b
    risaf-link inspect drive.tlog
    risaf-link inspect drive.tlog --plot rates.png
    """
    from risaf_link.config import load
    from risaf_link.survey import survey
    from risaf_link.words import pace_rows, survey_text

    if plot:
        from risaf_link.publish.plot import draw_paces, require

        require()
    with progress_over(log) as progress:
        found = survey(load(config_path, settings), log, progress)
    if plot:
        draw_paces(plot, log.name, pace_rows(found), found.duration)
    click.echo(survey_text(log, found))


@click.command()
@click.argument("log", type=click.Path(path_type=Path))
@configured
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    metavar="FILE",
    help="The calibration, YAML, for array.calibration.",
)
@selected
@click.option("--json", "as_json", is_flag=True, help="Print what was found as one JSON object.")
def calibrate(
    log: Path, config_path: Path | None, settings: tuple[str, ...], **options: Any
) -> None:
    """Find each gyro's bias, scale, misalignment and mounting, relative to the array.

    The log should have the array turned about all three axes, both ways, and some seconds at rest.
    Mountings are found, and the largest group of sensors that sit alike says what the body axes
    are; or they are taken from the calibration that --config names.

    \b
    risaf-link calibrate turned.tlog --out board-7.yaml
    risaf-link replay drive.tlog --set array.calibration=board-7.yaml
    """
    from risaf_link.calibrate import calibrate_log, summary, write
    from risaf_link.config import load
    from risaf_link.words import calibration_text

    config = load(config_path, settings)
    with progress_over(log) as progress:
        result = calibrate_log(config, log, options["start"], options["end"], progress)
    write(options["out"], log, result)
    found = summary(result)
    click.echo(json.dumps(found) if options["as_json"] else calibration_text(log, found))


def _replay_one(
    log: Path, config: "Config", selection: "Selection", options: dict[str, Any]
) -> None:
    from risaf_link.replay import Replay
    from risaf_link.words import summary_text

    replayed = Replay(config, log, selection)
    looking = _look_back(log, config, replayed, options)
    with ExitStack() as files, progress_over(log) as progress:
        sinks = _sinks(log, config, replayed, options, files)
        sinks += [looking.take] if looking else []
        singly = bool(options["out"] or options["speed"])
        for block in replayed.blocks(progress, singly):
            for sink in sinks:
                sink(block)
    if looking:
        looking.finish()
    summary = replayed.summary()
    click.echo(json.dumps(summary) if options["as_json"] else summary_text(log, summary))


def _replay_all(
    logs: tuple[Path, ...], config: "Config", selection: "Selection", options: dict[str, Any]
) -> None:
    from risaf_link.fleet import replay_all
    from risaf_link.words import fleet_text

    for name in ("speed", "out", "plot", "report", "mcap"):
        if options[name] is not None:
            raise ConfigError(f"--{name}: only for one log, without --workers and --cluster")
    spread = options["csv"], options["workers"], options["cluster"]
    rows = replay_all(logs, config, selection, *spread)
    click.echo(json.dumps(rows) if options["as_json"] else fleet_text(rows))
    failed = sum("error" in row for row in rows)
    if failed:
        raise LogError(f"{failed} of {len(rows)} logs gave nothing")


def _sinks(
    log: Path, config: "Config", replayed: "Replay", options: dict[str, Any], files: ExitStack
) -> list[Sink]:
    """What is to be done with the estimates."""
    from risaf_link.publish.rows import RowWriter
    from risaf_link.replay import OutputLog
    from risaf_link.whole import written

    sinks: list[Sink] = []
    if options["speed"]:
        sinks.append(_pace(options["speed"]))
    if options["out"]:
        file = files.enter_context(written(options["out"], "wb"))
        out = OutputLog(config, file, replayed.identity)
        sinks.append(out.write)
    if options["csv"]:
        rows = RowWriter(files.enter_context(written(options["csv"], "w")))
        sinks.append(rows.write)
    if options["mcap"]:
        from risaf_link.publish.mcap import McapWriter, require

        require()
        file = files.enter_context(written(options["mcap"], "wb"))
        mcap = files.enter_context(McapWriter(file, log.name))
        replayed.truth_listeners.append(mcap.take_truth)
        replayed.scorer.listeners.append(mcap.take_errors)
        sinks.append(mcap.take)
    return sinks


def _pace(speed: float) -> Sink:
    """Hold estimates back until their time has come."""
    began: list[float] = []

    def wait(block: "EstimateBlock") -> None:
        due = float(block.elapsed[-1]) / speed
        began[:] = began or [time.monotonic() - due]
        time.sleep(max(0.0, began[0] + due - time.monotonic()))

    return wait


def _look_back(
    log: Path, config: "Config", replayed: "Replay", options: dict[str, Any]
) -> "LookBack | None":
    """What is to be drawn when the log has ended."""
    if not (options["plot"] or options["report"]):
        return None
    from risaf_link.report import LookBack

    return LookBack(log, config, replayed, options["plot"], options["report"])
