"""Pictures from a folder; nothing outside it is ever read."""

from __future__ import annotations

import asyncio
import stat
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path, PurePosixPath, PureWindowsPath

from engine_adapters.errors import BadPicture, UnsafeText
from engine_adapters.pictures import picture_format
from engine_adapters.ports import EncodedFrame

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp"})

FILE_LIMIT_BYTES = 256 * 1024 * 1024
"""Largest file that is read: an uncompressed 8K BMP has 100 MB."""

NAME_LIMIT_CHARS = 1000

_DEVICE_NAMES = frozenset(
    {"CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$"} | {f"{port}{n}" for port in ("COM", "LPT") for n in range(10)}
)


class FolderPictures:
    """The picture folder port (:class:`engine_adapters.ports.PictureFolder`)."""

    def __init__(
        self, root: str | Path, *, limit_bytes: int = FILE_LIMIT_BYTES, executor: Executor | None = None
    ) -> None:
        """``root`` must be a folder. Raises ``BadPicture``."""
        self._root = Path(root).resolve()
        self._limit_bytes = limit_bytes
        self._executor = executor
        if not self._root.is_dir():
            raise BadPicture("no such folder; check its name", where=str(root))

    def names(self) -> Sequence[str]:
        """Every picture file below the folder, sorted, with forward slashes; links that lead out are left out."""
        found = []
        for path in self._root.rglob("*"):
            if path.suffix.lower() in SUFFIXES and path.is_file() and path.resolve().is_relative_to(self._root):
                found.append(path.relative_to(self._root).as_posix())
        return sorted(found)

    async def read(self, name: str) -> EncodedFrame:
        """One picture file by its name relative to the folder.

        Raises ``UnsafeText`` for a name that leads out of the folder, ``BadPicture`` for a missing, too large or other
        file. The read runs in a thread.
        """
        requested_at_s = time.monotonic()
        data = await asyncio.get_running_loop().run_in_executor(self._executor, self._read, name)
        return EncodedFrame(data, requested_at_s, time.monotonic(), source=name)

    def _read(self, name: str) -> bytes:
        path = self._inside(name)
        try:
            status = path.stat()
            if not stat.S_ISREG(status.st_mode):
                raise BadPicture("not a file", where=name)
            with path.open("rb") as file:
                data = file.read(self._limit_bytes + 1)
        except OSError as error:
            raise BadPicture(f"cannot be read ({error.strerror or error})", where=name) from error
        if len(data) > self._limit_bytes:
            raise BadPicture(f"larger than {self._limit_bytes} bytes", where=name)
        picture_format(data, where=name)
        return data

    def _inside(self, name: str) -> Path:
        shown = repr(name[:60])
        parts = PurePosixPath(name).parts
        # The same names are refused on every system, so that a picture set means the same everywhere.
        if (
            not parts
            or len(name) > NAME_LIMIT_CHARS
            or "\\" in name
            or ":" in name
            or not name.isprintable()
            or PurePosixPath(name).is_absolute()
            or PureWindowsPath(name).anchor
            or any(part in ("..", "~") or part != part.rstrip(" .") for part in parts)
            or any(part.split(".")[0].rstrip().upper() in _DEVICE_NAMES for part in parts)
        ):
            raise UnsafeText(f"picture name {shown}: must be a plain path below the folder, with / between its parts")
        try:
            path = self._root.joinpath(*parts).resolve()
        except (OSError, RuntimeError) as error:  # a link that leads to itself
            raise BadPicture(f"cannot be read ({error})", where=name) from error
        if not path.is_relative_to(self._root):
            raise UnsafeText(f"picture name {shown}: leads out of the folder by a link")
        return path
