"""The command line. Errors are one line; exit status 0 done, 2 user's mistake, 3 input unusable."""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from risaf_link import __version__
from risaf_link.errors import ConfigError, LinkError, LogError, RisafError

if TYPE_CHECKING:  # what a command needs is imported when it runs: help must come at once
    from risaf_link.config import Config
    from risaf_link.core.estimate import EstimateBlock
    from risaf_link.replay import Replay, Selection
    from risaf_link.report import LookBack

GROUPS = ("limits", "epoch", "replay", "log", "live", "start")  # of `bench`

EXIT_STATUS: dict[type[RisafError], int] = {ConfigError: 2, LinkError: 2, LogError: 3}

Command = TypeVar("Command", bound=Callable[..., Any])
Sink = Callable[["EstimateBlock"], None]


class _Commands(click.Group):
    """Turns errors that are meant for the user into one line and an exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except RisafError as error:
            click.echo(f"risaf-link: {error}", err=True)
            ctx.exit(EXIT_STATUS.get(type(error), 1))


class _Span(click.ParamType[Any]):
    """A time span, seconds."""

    name = "A:B"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            start, end = map(float, value.split(":"))
        except ValueError:
            self.fail(f"found {value!r}, expected A:B in seconds, such as 100:300", param, ctx)
        if not 0 <= start < end:
            self.fail(f"found {value!r}, expected 0 <= A < B", param, ctx)
        return start, end


def _configured(command: Command) -> Command:
    """Add the options that make a configuration."""
    setting = click.option(
        "--set",
        "settings",
        metavar="KEY=VALUE",
        multiple=True,
        help="Set one key over the configuration, such as fusion.method=mean. Repeatable.",
    )
    file = click.option(
        "--config",
        "config_path",
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="A YAML file; config/risaf_link.yaml shows every key.  [default: built-in defaults]",
    )
    return file(setting(command))


def _spread(command: Command) -> Command:
    """Add the options that say where many cases run."""
    workers = click.option(
        "--workers",
        type=click.IntRange(min=1),
        metavar="N",
        help="Processes.  [default: all cores]",
    )
    cluster = click.option(
        "--cluster", metavar="ADDRESS", help="A Dask scheduler (needs the extra `cluster`)."
    )
    return workers(cluster(command))


def _selected(command: Command) -> Command:
    """Add the options that choose a part of a log."""
    end = click.option(
        "--end",
        type=click.FloatRange(min=0),
        default=float("inf"),
        metavar="S",
        help="Stop after S seconds of the log.",
    )
    start = click.option(
        "--start",
        type=click.FloatRange(min=0),
        default=0.0,
        metavar="S",
        help="Skip the first S seconds of the log.",
    )
    return start(end(command))


class _Address(click.ParamType[Any]):
    """Where to listen."""

    name = "ADDRESS:PORT"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, int]:
        if isinstance(value, tuple):
            return value
        host, _, port = value.rpartition(":")
        if not host or not port.isdecimal() or int(port) > 65535:
            self.fail(f"found {value!r}, expected ADDRESS:PORT, such as 0.0.0.0:8765", param, ctx)
        return host, int(port)


def _listening(command: Command) -> Command:
    """Add the option that says where a page is served."""
    return click.option(
        "--listen",
        type=_Address(),
        default="127.0.0.1:8765",
        show_default=True,
        help="Where the page is served; on another address than this, everyone there sees it.",
    )(command)


def _tell_page(url: str) -> None:
    click.echo(f"page at {url} (Ctrl-C ends it)", err=True)


@contextmanager
def _extra(name: str) -> Iterator[None]:
    """Say which extra is missing where an import fails."""
    try:
        yield
    except ImportError as error:
        raise RisafError(
            f"needs {error.name}: install risaf-link with the extra `{name}`"
        ) from None


def _tell_version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    """Tell the version, and whether the kernel was built: it need not be imported for that."""
    if not wanted:
        return
    from importlib.util import find_spec

    kernel = "kernel built" if find_spec("risaf_link.core._kernel") else "no kernel, NumPy alone"
    click.echo(f"risaf-link, version {__version__} ({kernel})")
    ctx.exit()


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_tell_version)
def main() -> None:
    """One trustworthy attitude and heading from an array of cheap MEMS gyros, over MAVLink.

    \b
    risaf-link run --config vehicle.yaml
    risaf-link replay drive.tlog --outage 100:300 --csv drive.csv
    risaf-link inspect drive.tlog
    """


@main.command()
@_configured
@click.option("-v", "--verbose", is_flag=True, help="Say more, such as which peers come and go.")
def run(config_path: Path | None, settings: tuple[str, ...], verbose: bool) -> None:
    """Run the service until it is interrupted.

    Links that cannot be opened yet are retried for ever; SIGINT and SIGTERM end it.

    \b
    risaf-link run --config vehicle.yaml
    risaf-link run --set links.0.url=serial:///dev/ttyACM0:3000000
    """
    import asyncio
    import logging

    from risaf_link.config import load
    from risaf_link.kept import kept_parameters
    from risaf_link.service import Service, loop_factory, settled, until_told
    from risaf_link.supervisor import of_this_process

    level = logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(levelname)s %(message)s")
    config = load(config_path, settings)
    kept = kept_parameters(config, config_path, settings)
    service = Service(config, kept, supervisor=of_this_process())
    with settled(), asyncio.Runner(loop_factory=loop_factory()) as runner:
        runner.run(until_told(service.run()))


def _rooted(command: Command) -> Command:
    """Add the option that says which system is meant."""
    return click.option(
        "--root",
        type=click.Path(path_type=Path, exists=True, file_okay=False),
        default="/",
        metavar="DIR",
        help="Root directory of an image, where nothing is started.  [default: this system]",
    )(command)


@main.command()
@_rooted
@click.option(
    "--init",
    type=click.Choice(["systemd", "script"]),
    help="What starts services.  [default: systemd where it is, else a script in /etc/init.d]",
)
@click.option(
    "--program",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The risaf-link that is to run.  [default: this one]",
)
def install(root: Path, init: str | None, program: Path | None) -> None:
    """Make the service one of the system's, started with it and restarted when it fails.

    Writes a unit for systemd or a script, a udev rule for the array and
    /etc/risaf_link/vehicle.yaml. Files that were changed since are kept as they are.

    \b
    sudo /opt/risaf_link/bin/risaf-link install
    sudo systemctl start risaf-link
    """
    from risaf_link.install import Installation, this_program

    installation = Installation(root)
    systemd = installation.has_systemd if init is None else init == "systemd"
    for line in installation.install(program or this_program(), systemd):
        click.echo(line)


@main.command()
@_rooted
def uninstall(root: Path) -> None:
    """Undo `install`. What was changed since, learnt or recorded is kept.

    \b
    sudo /opt/risaf_link/bin/risaf-link uninstall
    """
    from risaf_link.install import Installation

    for line in Installation(root).uninstall():
        click.echo(line)


@main.command()
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path))
@_configured
@click.option(
    "--speed",
    type=click.FloatRange(min=0, min_open=True),
    metavar="N",
    help="Times real time, of one log.  [default: as fast as it goes]",
)
@_selected
@click.option(
    "--outage",
    "outages",
    type=_Span(),
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
@_spread
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


@main.command()
@click.argument("scenario")
@click.option("--seed", type=int, required=True, metavar="N", help="Of everything random.")
@click.option("--out", type=click.Path(path_type=Path), metavar="LOG.tlog", help="Write a tlog.")
@click.option("--live", "url", metavar="URL", help="Send in real time over a link.")
@click.option("--duration", type=float, metavar="S", help="Seconds.")
@click.option("--sensors", type=int, metavar="N", help="Gyros in the array.")
@click.option("--rate", type=float, metavar="HZ", help="Epochs a second.")
@click.option(
    "--faults",
    metavar="NAME,NAME",
    help="Faults of sensors and of GPS; `none`, or `default` for the scenario's own.",
)
def simulate(
    scenario: str, out: Path | None, url: str | None, faults: str | None, **size: Any
) -> None:
    """Simulate a vehicle with an array, as a tlog or live on a link.

    SCENARIO is one of `circle` (the paper's: noise, random walks of the biases, spikes), `drive1`
    (constant speed, GPS cut after 100 s), `drive2` (an unpaved road, a third of the array shocked,
    a long outage of GPS), `ekf2` (one sound IMU) and `demo` (an hour in which sensors and GPS come
    and go). The truth is in HIL_STATE_QUATERNION.

    \b
    risaf-link simulate circle --seed 1 --out circle.tlog
    risaf-link simulate drive2 --seed 1 --faults none --out smooth.tlog
    risaf-link simulate circle --seed 1 --sensors 150 --live udpout://127.0.0.1:14560
    """
    from risaf_link.sim.scenario import scenario as choose
    from risaf_link.sim.stream import frames, record_time_us

    chosen = choose(scenario, faults=faults.split(",") if faults else None, **size)
    if out is None and url is None:
        raise click.UsageError("expected --out LOG.tlog or --live URL")
    if out:
        from risaf_link.mavlink.tlog import record

        with _open(out, "wb") as file:
            for time_us, raw in frames(chosen):
                file.write(record(record_time_us(time_us), raw))
    if url:
        import asyncio

        from risaf_link.links import open_link
        from risaf_link.links.play import play
        from risaf_link.service import unix_us, until_told

        link = open_link(url, "--live", unix_us)
        asyncio.run(until_told(play(frames(chosen), link)))
        counts = link.counts
        click.echo(f"{counts.bytes_out} bytes sent, {counts.dropped_out} frames dropped", err=True)


@main.command()
@click.argument("source", metavar="URL|LOG")
@_listening
def monitor(source: str, listen: tuple[str, int]) -> None:
    """Show vehicles on a page in the browser: live from a link, or from a log.

    A URL is one of those that `run` takes. The page finds the risaf_link components there, asks
    them for what it shows, and everybody for the time; nothing else is sent. Needs the extra
    `monitor`.

    \b
    risaf-link monitor udpin://0.0.0.0:14550
    risaf-link monitor udpout://192.168.1.10:14560
    risaf-link monitor drive.tlog
    """
    import asyncio
    import logging

    with _extra("monitor"):
        from risaf_link.monitor.server import serve
    from risaf_link.links import open_link
    from risaf_link.monitor.recording import Player, open_recording
    from risaf_link.monitor.source import Live, Log, Source
    from risaf_link.service import unix_us, until_told

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    path = Path(source.removeprefix("tlog://"))
    shown: Source
    if "://" in source and not source.startswith("tlog://"):
        shown = Live(source, open_link(source, "URL", unix_us), unix_us)
    else:
        with _progress(path) as progress:
            shown = Log(path.name, Player(open_recording(path, progress)))
    asyncio.run(until_told(serve(shown, *listen, _tell_page)))


@main.command()
@click.option("--seed", type=int, default=1, metavar="N", help="Of the drive and its faults.")
@_listening
def demo(seed: int, listen: tuple[str, int]) -> None:
    """Show it all without hardware: a simulated vehicle, the service, and the page.

    Faults of sensors and of GPS come and go. Needs the extra `monitor`.

    \b
    risaf-link demo
    """
    import asyncio
    import logging

    with _extra("monitor"):
        from risaf_link.demo import demo as show
    from risaf_link.service import unix_us, until_told

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    tell = partial(click.echo, err=True)
    asyncio.run(until_told(show(listen, seed, unix_us, tell)))


@main.command()
@click.argument("log", type=click.Path(path_type=Path))
@_configured
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
    with _progress(log) as progress:
        found = survey(load(config_path, settings), log, progress)
    if plot:
        draw_paces(plot, log.name, pace_rows(found), found.duration)
    click.echo(survey_text(log, found))


@main.command()
@click.argument("log", type=click.Path(path_type=Path))
@_configured
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    metavar="FILE",
    help="The calibration, YAML, for array.calibration.",
)
@_selected
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
    with _progress(log) as progress:
        result = calibrate_log(config, log, options["start"], options["end"], progress)
    write(options["out"], log, result)
    found = summary(result)
    click.echo(json.dumps(found) if options["as_json"] else calibration_text(log, found))


@main.command()
@click.argument("name")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="Where figures and numbers go; one that was interrupted goes on from there.",
)
@click.option(
    "--seeds",
    type=click.IntRange(min=1),
    metavar="N",
    help="At most so many.  [default: 20, fewer in some]",
)
@click.option("--quick", is_flag=True, help="Few seeds, few sensors, short drives.")
@click.option(
    "--method",
    "methods",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE.py",
    help="A method of your own to compare. Repeatable.",
)
@_spread
def experiment(name: str, out: Path, **options: Any) -> None:
    """Repeat one of the paper's figures or tables, with every method on the same input.

    NAME is one of `sensors` (fig. 1, 2), `circle` (fig. 5), `montecarlo` (fig. 6), `drive1`
    (fig. 9, 10, 14), `drive2` (fig. 12, 13, 15), `outages` (fig. 16), `faults` (one kind at a
    time), `sensitivity` (section III.B), `cost` (table I), and `all`, which adds a page, index.md.
    Each leaves a PNG, JSON and CSV. Needs the extra `plot`.

    \b
    risaf-link experiment drive1 --out results
    risaf-link experiment all --quick --out results
    risaf-link experiment montecarlo --method mine.py --out results
    """
    from risaf_link.experiments.run import experiment as perform

    for section in perform(name, out, **options):
        click.echo(out / f"{section.name}.png")


@main.command()
@click.option("--quick", is_flag=True, help="Minutes become seconds; the figures spread more.")
@click.option(
    "--only",
    "groups",
    type=click.Choice(GROUPS),
    multiple=True,
    help="One kind of figures: what bounds them all, epochs, replays, logs of autopilots, the live "
    "service, its start. Repeatable.",
)
@click.option(
    "--log",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="LOG.tlog",
    help="A log of an autopilot to read, in place of one that is made.",
)
@click.option(
    "--minutes",
    type=click.FloatRange(min=0, min_open=True),
    metavar="N",
    help="How long 300 gyros are sent at 1 kHz.  [default: 20 s]",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def bench(
    quick: bool, groups: tuple[str, ...], log: Path | None, minutes: float | None, as_json: bool
) -> None:
    """Measure how fast it is on this machine, beside what else there is.

    Every figure has a reference that was measured in the same run: the NumPy form, pymavlink and,
    where they are installed (the extra `bench`), imufusion, vqf and fasttlogparser. Nothing leaves
    127.0.0.1. The live service is measured on Linux.

    \b
    risaf-link bench
    risaf-link bench --quick --only live --json
    risaf-link bench --only live --minutes 10
    """
    from dataclasses import replace

    from rich.console import Console

    from risaf_link.bench import FULL, QUICK
    from risaf_link.bench import bench as measure
    from risaf_link.bench.machine import machine
    from risaf_link.bench.table import as_object, show

    extent = QUICK if quick else FULL
    if minutes:
        extent = replace(extent, fast_s=60.0 * minutes)
    where = machine()
    figures = []
    with Console(stderr=True).status("measuring") as status:
        for figure in measure(extent, groups or GROUPS, log):
            status.update(figure.text)
            figures.append(figure)
    if as_json:
        click.echo(json.dumps(as_object(where, figures)))
    else:
        show(where, figures, Console())


@main.command("check-config")
@click.argument("file", type=click.Path(path_type=Path))
def check_config(file: Path) -> None:
    """Say what is wrong with a configuration, or print it whole with the defaults.

    \b
    risaf-link check-config config/risaf_link.yaml
    """
    from risaf_link.config import dump, load, load_calibration
    from risaf_link.keys import open_keys
    from risaf_link.publish.access import broker_of

    config = load(file)
    load_calibration(config)
    open_keys(config)
    if config.mqtt.url:
        broker_of(config.mqtt)
    click.echo(dump(config), nl=False)


def _replay_one(
    log: Path, config: "Config", selection: "Selection", options: dict[str, Any]
) -> None:
    from risaf_link.replay import Replay
    from risaf_link.words import summary_text

    replayed = Replay(config, log, selection)
    looking = _look_back(log, config, replayed, options)
    with ExitStack() as files, _progress(log) as progress:
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


def _open(path: Path, mode: str) -> Any:
    try:
        return path.open(mode)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None


def _sinks(
    log: Path, config: "Config", replayed: "Replay", options: dict[str, Any], files: ExitStack
) -> list[Sink]:
    """What is to be done with the estimates."""
    from risaf_link.publish.rows import RowWriter
    from risaf_link.replay import OutputLog

    sinks: list[Sink] = []
    if options["speed"]:
        sinks.append(_pace(options["speed"]))
    if options["out"]:
        file = files.enter_context(_open(options["out"], "wb"))
        out = OutputLog(config, file, replayed.identity)
        sinks.append(out.write)
    if options["csv"]:
        rows = RowWriter(files.enter_context(_open(options["csv"], "w")))
        sinks.append(rows.write)
    if options["mcap"]:
        from risaf_link.publish.mcap import McapWriter, require

        require()
        mcap = McapWriter(files.enter_context(_open(options["mcap"], "wb")), log.name)
        files.callback(mcap.finish)
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


@contextmanager
def _progress(log: Path) -> Iterator[Callable[[int], None]]:
    """Show a progress bar over the bytes of a log, on a terminal."""
    if not sys.stderr.isatty() or not log.is_file():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(log.name, total=log.stat().st_size)
        yield lambda size: bar.advance(task, size)


if __name__ == "__main__":
    main(prog_name="risaf-link")
