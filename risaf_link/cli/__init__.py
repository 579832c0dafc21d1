"""The command line. Errors are one line; exit status 0 done, 2 user's mistake, 3 input unusable.

What a command needs is imported when it runs: help must come at once.
"""

from typing import Any

import click

from risaf_link import __version__
from risaf_link.cli.logs import calibrate, inspect, replay
from risaf_link.cli.trials import bench, experiment
from risaf_link.cli.vehicle import check_config, demo, install, monitor, run, simulate, uninstall
from risaf_link.errors import ConfigError, LinkError, LogError, RisafError

EXIT_STATUS: dict[type[RisafError], int] = {ConfigError: 2, LinkError: 2, LogError: 3}


class _Commands(click.Group):
    """Turns errors that are meant for the user into one line and an exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except RisafError as error:
            click.echo(f"risaf-link: {error}", err=True)
            ctx.exit(EXIT_STATUS.get(type(error), 1))


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


for command in (bench, calibrate, check_config, demo, experiment, inspect, install):
    main.add_command(command)
for command in (monitor, replay, run, simulate, uninstall):
    main.add_command(command)
