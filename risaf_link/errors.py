"""What can go wrong for a caller, by what he can do about it."""


class RisafError(Exception):
    """Anything that this package reports as an error; its text is one line."""


class ConfigError(RisafError):
    """A configuration that cannot be used: which key, what was found, what was expected."""


class LinkError(RisafError):
    """A link that cannot be opened or described: which URL, and why."""


class LogError(RisafError):
    """A log that cannot be read or holds nothing usable: which file, and why."""
