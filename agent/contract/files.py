"""Files are written whole or not at all, and never over another one unless asked."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from agent.contract.errors import InputError, shortened


def canonical(document: Any) -> bytes:
    """The one JSON text of a document: sorted keys, no spaces, shortest decimals that give back every float."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def digest(document: Any) -> str:
    """SHA-256 of the canonical JSON, in hexadecimal."""
    return hashlib.sha256(canonical(document)).hexdigest()


def refuse_overwrite(path: Path, *, force: bool) -> None:
    """Raise InputError where `path` exists and `force` was not given, or its folder does not exist."""
    if path.is_symlink():  # renaming would replace the link, and leave alone what it leads to
        raise InputError(f"{path} is a symbolic link and will not be replaced; name the file that it leads to")
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file in it")
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is not a regular file and will not be replaced; give another name")
    if path.exists() and not force:
        raise InputError(f"{path} exists already; give another name, or --force to replace it")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist; create it first")


def write_whole(path: Path, data: bytes, *, force: bool = False) -> None:
    """Write `data` beside `path`, then rename: a reader sees the old file or the new one, nothing between."""
    with writing_whole(path, force=force) as part, part.open("wb") as file:
        file.write(data)


@contextmanager
def writing_whole(path: Path, *, force: bool = False) -> Iterator[Path]:
    """A file beside `path` to write to; it gets the name `path` at the end of the block, and goes where that fails."""
    refuse_overwrite(path, force=force)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path} could not be written: {error.strerror}") from error
    finally:
        part.unlink(missing_ok=True)


class RepeatedKey(ValueError):
    """A key is there twice, of which readers take one or the other."""


def read_json(data: bytes) -> Any:
    """What JSON says. ValueError: it is none, or a RepeatedKey."""
    return json.loads(data, object_pairs_hook=_without_repeats)


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise RepeatedKey(f"the key {shortened(repeated)} is there {names.count(repeated)} times; keep one of them")
    return found


def kind_of(data: bytes) -> str:
    """What a file seems to be, for a refusal: "a recording", "a gains file", "a problem file", or "" where unknown."""
    if data.startswith(b"\x89MCAP0"):
        return "a recording"
    if data.lstrip().startswith(b"{") and b'"format":"peakmesh-gains"' in data:
        return "a gains file"
    if b"[plant]" in data:
        return "a problem file"
    return ""


def read_bytes(path: Path, *, kind: str) -> bytes:
    """The file's bytes, or an InputError that says why not. `kind` names what was expected of it."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; a {kind} was expected there") from None
    except OSError as error:
        raise InputError(f"{path} could not be read as a {kind}: {error.strerror}") from error
