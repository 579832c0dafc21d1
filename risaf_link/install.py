"""Make the service one of the system's, with systemd or without, and undo it.

What was put where is noted with a checksum in /etc/risaf_link/.installed: a file that has been
changed since is the user's, and neither replaced nor removed.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

import msgspec

from risaf_link.errors import ConfigError
from risaf_link.whole import replace_file

UNIT = Path("etc/systemd/system/risaf-link.service")
WANTED = Path("etc/systemd/system/multi-user.target.wants/risaf-link.service")
SCRIPT = Path("etc/init.d/risaf-link")
RULES = Path("etc/udev/rules.d/70-risaf-link.rules")
CONFIGURATION = Path("etc/risaf_link/vehicle.yaml")
NOTED = Path("etc/risaf_link/.installed")
KEPT = (Path("var/lib/risaf_link"), Path("var/log/risaf_link"))  # never removed: the vehicle's own
HIDDEN = ("/home/", "/root/", "/run/user/", "/tmp/")  # from the service  # noqa: S108
USER = "risaf-link"
SYSTEMD = ("usr/lib/systemd/systemd", "lib/systemd/systemd")


class Installation:
    """Files of the service below a root directory.

    Parameters
    ----------
    root : Path
        `/`, or that of an image.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._noted = self._read_noted()

    @property
    def has_systemd(self) -> bool:
        """Whether systemd is what starts services there."""
        if self._is_running:
            return Path("/run/systemd/system").is_dir()
        return any((self._root / path).exists() for path in SYSTEMD)

    @property
    def _is_running(self) -> bool:
        return self._root.resolve() == Path("/")

    def install(self, program: Path, systemd: bool) -> Iterator[str]:
        """Put everything in its place.

        Parameters
        ----------
        program : Path
            What is to be run.
        systemd : bool
            Whether there is systemd.

        Yields
        ------
        str
            What was done, a line each.

        Raises
        ------
        ConfigError
            If something cannot be written, or the service could not run the program.
        """
        if str(program).startswith(HIDDEN):
            raise ConfigError(
                f"{program}: found a program in a place that services do not see, expected one "
                "elsewhere, such as in a virtual environment below /opt"
            )
        start = UNIT if systemd else SCRIPT
        template = _packaged(f"risaf-link.{'service' if systemd else 'init'}")
        text = template.replace("@RISAF_LINK@", str(program))
        yield self._put(start, text, executable=not systemd)
        yield self._put(RULES, _packaged("70-risaf-link.rules"))
        yield self._put(CONFIGURATION, _packaged("vehicle.yaml"))
        if systemd:
            yield self._enable()
        self._write_noted()
        if self._is_running:
            yield from _run(_BEGIN_SYSTEMD if systemd else _BEGIN_SCRIPT)

    def uninstall(self) -> Iterator[str]:
        """Remove what was installed and has not been changed since.

        Yields
        ------
        str
            What was done, a line each.

        Raises
        ------
        ConfigError
            If something cannot be removed.
        """
        if self._is_running and self._noted:
            yield from _run(_END_SYSTEMD if str(UNIT) in self._noted else _END_SCRIPT)
        for name, noted in self._noted.items():
            path = self._root / name
            found = _found(path)
            if found is None:
                continue
            if found != noted:
                yield f"kept {path}: it has been changed"
                continue
            with _told(path):
                path.unlink()
            yield f"removed {path}"
        noted_at = self._root / NOTED
        with _told(noted_at):
            noted_at.unlink(missing_ok=True)
            if noted_at.parent.is_dir() and not any(noted_at.parent.iterdir()):
                noted_at.parent.rmdir()
        for path in KEPT:
            if (self._root / path).exists():
                yield f"kept {self._root / path}: what the vehicle learnt and recorded"

    def _put(self, name: Path, text: str, *, executable: bool = False) -> str:
        path, content = self._root / name, text.encode()
        found, wanted = _found(path), _checksum(content)
        if found == wanted:
            self._noted[str(name)] = wanted
            return f"{path} is there"
        if found is not None and found != self._noted.get(str(name)):
            return f"kept {path}: it has been changed"
        with _told(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, content)
            path.chmod(0o755 if executable else 0o644)
        self._noted[str(name)] = wanted
        return f"{'replaced' if found else 'wrote'} {path}"

    def _enable(self) -> str:
        """Let it start with the system."""
        path, target = self._root / WANTED, f"/{UNIT}"
        if not path.is_symlink():
            with _told(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                path.symlink_to(target)
        self._noted[str(WANTED)] = _found(path) or ""
        return f"{path} starts it with the system"

    def _read_noted(self) -> dict[str, str]:
        try:
            return msgspec.json.decode((self._root / NOTED).read_bytes(), type=dict[str, str])
        except (FileNotFoundError, msgspec.DecodeError):
            return {}
        except OSError as error:
            raise ConfigError(f"{self._root / NOTED}: {error.strerror}") from None

    def _write_noted(self) -> None:
        with _told(self._root / NOTED):
            replace_file(self._root / NOTED, msgspec.json.encode(self._noted))


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Turn the system's refusal into one line for the user."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None


def this_program() -> Path:
    """The `risaf-link` that is running, as an absolute path."""
    beside = Path(sys.executable).absolute().with_name("risaf-link")
    found = beside if beside.exists() else Path(shutil.which("risaf-link") or sys.argv[0])
    return found.absolute()


_BEGIN_SYSTEMD = ("systemctl daemon-reload", "udevadm control --reload")
_END_SYSTEMD = ("systemctl disable --now risaf-link",)
_BEGIN_SCRIPT = (
    f"useradd --system --no-create-home --shell /usr/sbin/nologin --groups dialout {USER}",
    f"install -d -m 0700 -o {USER} /var/lib/risaf_link /var/log/risaf_link",
    "update-rc.d risaf-link defaults",
    "udevadm control --reload",
)
_END_SCRIPT = (f"/{SCRIPT} stop", "update-rc.d -f risaf-link remove")


def _run(commands: tuple[str, ...]) -> Iterator[str]:
    """Run commands of the system, as far as it has them; what they say is passed on."""
    for command in commands:
        program, *arguments = command.split()
        path = shutil.which(program)
        if path is None:
            yield f"left out, there is no {program}: {command}"
            continue
        done = subprocess.run(  # noqa: S603 they stand above
            [path, *arguments], capture_output=True, text=True, check=False
        )
        said = " ".join((done.stdout + done.stderr).split())
        yield f"{'ran' if done.returncode == 0 else 'failed'} {command}{said and f': {said}'}"


def _packaged(name: str) -> str:
    """Text of a file that comes with the program."""
    here = Path(__file__).parent
    places = here / "packaging", here.parent / "packaging"  # as installed; as it is developed
    return next(place for place in places if place.is_dir()).joinpath(name).read_text()


def _found(path: Path) -> str | None:
    """Checksum of what is at a place; None: nothing is."""
    with _told(path):
        if path.is_symlink():
            content = os.fsencode(path.readlink())
        elif path.exists():
            content = path.read_bytes()
        else:
            return None
    return _checksum(content)


def _checksum(content: bytes) -> str:
    return sha256(content).hexdigest()
