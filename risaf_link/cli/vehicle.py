"""Commands that run: the service and what belongs to it, simulated vehicles, the page."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from risaf_link.cli.options import (
    configured,
    extra,
    interrupted,
    listening,
    progress_over,
    rooted,
)


@click.command()
@configured
@click.option("-v", "--verbose", is_flag=True, help="Say more, such as which peers come and go.")
@interrupted
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
    from risaf_link.loop import loop_factory, settled, until_told
    from risaf_link.service import Service
    from risaf_link.supervisor import of_this_process

    level = logging.INFO if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(levelname)s %(message)s")
    config = load(config_path, settings)
    kept = kept_parameters(config, config_path, settings)
    service = Service(config, kept, supervisor=of_this_process())
    with settled(), asyncio.Runner(loop_factory=loop_factory()) as runner:
        runner.run(until_told(service.run()))


@click.command("check-config")
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


@click.command()
@rooted
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


@click.command()
@rooted
def uninstall(root: Path) -> None:
    """Undo `install`. What was changed since, learnt or recorded is kept.

    \b
    sudo /opt/risaf_link/bin/risaf-link uninstall
    """
    from risaf_link.install import Installation

    for line in Installation(root).uninstall():
        click.echo(line)


@click.command()
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
        from risaf_link.whole import written

        with written(out, "wb") as file:
            for time_us, raw in frames(chosen):
                file.write(record(record_time_us(time_us), raw))
    if url:
        import asyncio

        from risaf_link.links import open_link
        from risaf_link.links.play import play
        from risaf_link.loop import unix_us, until_told

        link = open_link(url, "--live", unix_us)
        asyncio.run(until_told(play(frames(chosen), link)))
        counts = link.counts
        click.echo(f"{counts.bytes_out} bytes sent, {counts.dropped_out} frames dropped", err=True)


@click.command()
@click.argument("source", metavar="URL|LOG")
@click.option(
    "--key",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Signing key of the link: show only what is signed with it, and sign what is sent.",
)
@listening
@interrupted
def monitor(source: str, key: Path | None, listen: tuple[str, int]) -> None:
    """Show vehicles on a page in the browser: live from a link, or from a log.

    A URL is one of those that `run` takes. The page finds the risaf_link components there, asks
    them for what it shows, and everybody for the time; nothing else is sent. Needs the extra
    `monitor`.

    \b
    risaf-link monitor udpin://0.0.0.0:14550
    risaf-link monitor udpout://192.168.1.10:14560 --key signing.key
    risaf-link monitor drive.tlog
    """
    import asyncio
    import logging

    with extra("monitor"):
        from risaf_link.monitor.server import serve
    from risaf_link.errors import ConfigError
    from risaf_link.keys import open_key
    from risaf_link.links import open_link
    from risaf_link.loop import unix_us, until_told
    from risaf_link.monitor.recording import Player, open_recording
    from risaf_link.monitor.source import Live, Log, Source

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    path = Path(source.removeprefix("tlog://"))
    shown: Source
    if "://" in source and not source.startswith("tlog://"):
        signing = open_key(key, "--key") if key else None
        shown = Live(source, open_link(source, "URL", unix_us), unix_us, signing)
    elif key:
        raise ConfigError("--key: found it with a log, expected it with a link")
    else:
        with progress_over(path) as progress:
            shown = Log(path.name, Player(open_recording(path, progress)))
    asyncio.run(until_told(serve(shown, *listen, _tell_page)))


def _tell_page(url: str) -> None:
    click.echo(f"page at {url} (Ctrl-C ends it)", err=True)


@click.command()
@click.option("--seed", type=int, default=1, metavar="N", help="Of the drive and its faults.")
@listening
@interrupted
def demo(seed: int, listen: tuple[str, int]) -> None:
    """Show it all without hardware: a simulated vehicle, the service, and the page.

    Faults of sensors and of GPS come and go. Needs the extra `monitor`.

    \b
    risaf-link demo
    """
    import asyncio
    import logging

    with extra("monitor"):
        from risaf_link.demo import demo as show
    from risaf_link.loop import unix_us, until_told

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    tell = partial(click.echo, err=True)
    asyncio.run(until_told(show(listen, seed, unix_us, tell)))
