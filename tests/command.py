"""The command line, as a user types it."""

from click.testing import CliRunner, Result

from risaf_link.cli import main


def call(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])
