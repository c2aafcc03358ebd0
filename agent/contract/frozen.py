"""Pydantic models of which every instance was validated, the copies too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NoReturn, Self, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from agent.contract.errors import InputError, Location, first_fault, listed


class Frozen(BaseModel):
    """Never changed, and never made but by validation.

    Pydantic's own copies skip validation, keep what properties have cached of the original, and keep a key that is
    misspelt; arrays come back from copy.deepcopy and pickle writable. Here every copy is the document read anew.
    """

    model_config = ConfigDict(frozen=True)

    def document(self) -> Any:
        """The model as plain lists, dicts, strings and numbers, under the names used in files.

        What is None is left out, so that the digest of a file stays what it is when a later version knows more.
        """
        return self.model_dump(by_alias=True, exclude_none=True)

    @classmethod
    def from_document(cls, document: Any) -> Self:
        """The inverse of `document`. Raises InputError: one sentence naming the place, the value, what is right."""
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            raise InputError(first_fault(error, document, cls.keys_at)) from None

    @classmethod
    def keys_at(cls, location: Location) -> set[str]:
        """The keys that the table at a location of a document may have."""
        kinds: set[type[BaseModel]] = {cls}
        for step in location:
            fields = {field.alias or name: field for kind in kinds for name, field in kind.model_fields.items()}
            if step in fields:  # else it is the index in a list, or the tag of a union
                kinds = set(_models_in(fields[str(step)].annotation))
        return {field.alias or name for kind in kinds for name, field in kind.model_fields.items()}

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """The same with other values of some fields; `deep` or not, nothing is shared. Raises InputError."""
        fields, changes = type(self).model_fields, update or {}
        if unknown := changes.keys() - fields.keys():
            raise InputError(f"{type(self).__name__} has no field {listed(sorted(unknown))}; it has {listed(fields)}")
        changed = {fields[name].alias or name: plain(value) for name, value in changes.items()}
        return self.from_document(self.document() | changed)

    def __copy__(self) -> Self:
        return self.model_copy()

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        return self.model_copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return self.from_document, (self.document(),)

    @classmethod
    def model_construct(cls, _fields_set: set[str] | None = None, **values: Any) -> NoReturn:  # type: ignore[override]  # mypy's plugin
        raise TypeError(f"{cls.__name__} is never made without validation; call {cls.__name__}(...)")

    def copy(self, **options: Any) -> NoReturn:
        raise TypeError("copy is pydantic 1, and does not validate; call model_copy(update={...})")


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models that a field of this type may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models_in(part)


def plain(value: Any) -> Any:
    """A value of a field as it stands in a document."""
    match value:
        case Frozen():
            return value.document()
        case np.ndarray() | np.generic():
            return value.tolist()
        case list() | tuple():
            return [plain(entry) for entry in value]
        case dict():
            return {key: plain(entry) for key, entry in value.items()}
    return value
