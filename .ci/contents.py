"""See that an sdist or a wheel holds what it should, and nothing else.

An sdist: what is under version control, and its metadata. A wheel: the package, with the kernel and
the data that it reads.
"""

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

NATIVE = ("risaf_link/core/native/", "risaf_link/mavlink/native/")
KERNEL = "risaf_link/core/_kernel."
BUILT = (".so", ".pyc")
LEFT = {".git", ".venv", "__pycache__", "build", "dist", "out", "node_modules", ".hypothesis"}
LEFT |= {".mypy_cache", ".pytest_cache", ".ruff_cache"}


def tracked() -> set[str]:
    """What is under version control; where this is no clone, what nobody has built."""
    command = ["git", "-c", "safe.directory=*", "ls-files", "-z"]
    try:
        told = subprocess.check_output(command, text=True, stderr=subprocess.DEVNULL)  # noqa: S603
    except (OSError, subprocess.CalledProcessError):
        print("no clone of the repository: what is there is taken for what should be")
        there = (path for path in Path().rglob("*") if path.is_file())
        return {str(p) for p in there if p.suffix not in BUILT and LEFT.isdisjoint(p.parts)}
    return set(told.rstrip("\0").split("\0"))


def of_sdist(path: Path) -> tuple[set[str], set[str]]:
    """What is in it, and what should be."""
    with tarfile.open(path) as archive:
        names = {member.name.partition("/")[2] for member in archive if not member.isdir()}
    return names, tracked() | {"PKG-INFO"}


def of_wheel(path: Path) -> tuple[set[str], set[str]]:
    """What is in it, but for its metadata, and what should be."""
    with zipfile.ZipFile(path) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    kernel = {name for name in names if name.startswith(KERNEL) and name.endswith(".so")}
    expected = {
        f"risaf_link/{name}" if name.startswith("packaging/") else name
        for name in tracked()
        if name.startswith(("risaf_link/", "packaging/")) and not name.startswith(NATIVE)
    }
    return names, expected | (kernel or {f"{KERNEL}*.so"})


def main() -> None:
    """Say what is missing or too much, and fail then."""
    path = Path(sys.argv[1])
    found, expected = of_wheel(path) if path.suffix == ".whl" else of_sdist(path)
    wrong = [f"missing: {name}" for name in sorted(expected - found)]
    wrong += [f"stray: {name}" for name in sorted(found - expected)]
    if wrong:
        sys.exit("\n".join([f"{path.name}:", *wrong]))
    print(f"{path.name}: {len(found)} files, as it should be")


if __name__ == "__main__":
    main()
