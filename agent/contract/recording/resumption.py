"""A recording whose recorder was killed, as the recorder after it finds it: what is in it, and where it goes on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from agent.contract.errors import InputError
from agent.contract.recording import Logged
from agent.contract.recording.parts import files_of, unfinished
from agent.contract.recording.reader import RecordingReader

_ASIDE = ".cut"  # what the killed recorder left is called so until its messages stand in a file again


class Cut:
    """The recording `path`: parts that are whole, and one at the end that nobody writes any more."""

    def __init__(self, path: Path, files: list[Path]) -> None:
        self._whole, self._cut = files[:-1], files[-1]
        with RecordingReader(files[0], follows=False) as reader:
            kept = {key: text for key, text in reader.run.items() if key not in ("format", "version", "part")}
        self.run = kept
        self.part = len(files)  # the number of the one that was cut

    @classmethod
    def of(cls, path: Path) -> Cut | None:
        """None where there is no such recording: nothing, a whole one, or something else."""
        files = files_of(path)
        if not files or not files[-1].name.endswith(unfinished(path).suffix):
            return None
        try:
            return cls(path, files)
        except InputError:
            return None

    def before(self) -> Iterator[Logged]:
        """The messages of the parts that are whole."""
        for file in self._whole:
            with RecordingReader(file, follows=False) as reader:
                yield from reader.messages()

    def set_aside(self) -> None:
        """Give the name of the last part free, for a file that is whole."""
        aside = self._cut.with_name(self._cut.name + _ASIDE)
        self._cut.replace(aside)
        self._cut = aside

    def messages(self) -> Iterator[Logged]:
        """Those of the last part, as far as it goes."""
        with RecordingReader(self._cut, follows=False) as reader:
            yield from reader.messages()

    def remove(self) -> None:
        """Its messages stand in another file."""
        self._cut.unlink()
