"""Sections whose keys are described by the text below each of them, and texts among their values."""

import ast
import sys
from collections.abc import Callable, Iterator
from functools import cache
from inspect import cleandoc, getsource
from itertools import pairwise
from typing import Any

from pydantic import AfterValidator, BaseModel, ConfigDict


def text_for(parse: Callable[[str], object]) -> AfterValidator:
    """Of a text that ``parse`` takes without a ValueError, and that stays as it is."""

    def checked(text: str) -> str:
        parse(text)
        return text

    return AfterValidator(checked)


class Described(BaseModel):
    """A section whose unknown keys are errors, and whose values cannot change. In its JSON schema the text below a key,
    or among its annotations where it is that of a dataclass, is its description, unless its field has one.

    Pydantic's ``use_attribute_docstrings`` reads the file of a section for each section as the program starts, which
    adds 0.4 s to the 1.6 s of processor time of ``en4dvar validate``; these are read where a schema is asked for.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> dict[str, Any]:
        schema: dict[str, Any] = handler(core_schema)
        keys = handler.resolve_ref_schema(schema)["properties"]
        for name, own in cls.model_fields.items():
            if words := [text for text in own.metadata if isinstance(text, str)]:
                keys[own.alias or name].setdefault("description", " ".join(words))
        for kind in reversed([kind for kind in cls.__mro__ if issubclass(kind, Described)]):
            for name, text in _texts_of(kind.__module__).get(kind.__qualname__, {}).items():
                field = cls.model_fields.get(name)
                if field and field.description is None:
                    keys[field.alias or name]["description"] = text
        return schema


@cache
def _texts_of(module: str) -> dict[str, dict[str, str]]:
    """Class → key → text below it, in the file of a module. A class made in memory has descriptions in its fields."""
    try:
        file = ast.parse(getsource(sys.modules[module]))
    except (OSError, TypeError):  # the interpreter's own prompt
        return {}
    return {kind.name: dict(_below(kind)) for kind in file.body if isinstance(kind, ast.ClassDef)}


def _below(kind: ast.ClassDef) -> Iterator[tuple[str, str]]:
    for key, text in pairwise(kind.body):
        match key, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                yield name, cleandoc(words)
