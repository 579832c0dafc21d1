"""What can go wrong for a caller, by what he can do about it."""


class RisafError(Exception):
    """Anything that this package reports as an error; its text is one line.

    What it quotes may hold line breaks, or tell a terminal what to do: it is told as Python writes
    such characters.
    """

    def __str__(self) -> str:
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in super().__str__())


class ConfigError(RisafError):
    """A configuration that cannot be used: which key, what was found, what was expected."""


class LinkError(RisafError):
    """A link that cannot be opened or described: which URL, and why."""


class LogError(RisafError):
    """A log that cannot be read or holds nothing usable: which file, and why."""
