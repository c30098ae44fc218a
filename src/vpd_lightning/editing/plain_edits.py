"""Edits and selectors as plain values, and back: what an edit file holds."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from difflib import get_close_matches
from typing import Any

from vpd_lightning.editing.operations import (
    Delete,
    Duplicate,
    Insert,
    InsertPoints,
    Move,
    Operation,
    Scale,
    SetVelocity,
)
from vpd_lightning.editing.rotation import about_axis
from vpd_lightning.editing.selectors import AllOf, AnyOf, Box, Cluster, Color, Everything, Lasso, Not, Selector, Sphere
from vpd_lightning.errors import EditError

SELECTORS: dict[str, type[Selector]] = {
    "everything": Everything,
    "box": Box,
    "sphere": Sphere,
    "lasso": Lasso,
    "color": Color,
    "cluster": Cluster,
}
OPERATIONS: dict[str, type[Operation]] = {
    "delete": Delete,
    "move": Move,
    "scale": Scale,
    "duplicate": Duplicate,
    "insert": Insert,
    "insert_points": InsertPoints,
    "set_velocity": SetVelocity,
}
_SETS = ("any_of", "all_of", "not")
MAX_DEPTH = 20
"""Selections nested deeper than this are refused."""


def plain_selector(selector: Selector) -> dict[str, Any]:
    """Return a selector as plain values.

    Raises:
        EditError: it is a mask, which means nothing in another scene.
    """
    if isinstance(selector, AnyOf | AllOf):
        return {"any_of" if isinstance(selector, AnyOf) else "all_of": [plain_selector(p) for p in selector.parts]}
    if isinstance(selector, Not):
        return {"not": plain_selector(selector.part)}
    for name, kind in SELECTORS.items():
        if isinstance(selector, kind):
            return {name: _plain_fields(selector)}
    raise EditError(
        "A mask of particles holds for one scene only and cannot be stored.\n"
        "Select by box, sphere, lasso, colour or cluster."
    )


def selector_from(plain: Any, where: str, depth: int = 0) -> Selector:
    """Return the selector that plain values describe.

    Raises:
        EditError: they describe none; ``where`` names their place in the file.
    """
    if depth > MAX_DEPTH:
        raise EditError(f"{where} is nested more than {MAX_DEPTH} deep.")
    if not isinstance(plain, Mapping) or len(plain) != 1:
        raise EditError(
            f"{where} is {_short(plain)}.\nExpected one of {', '.join((*SELECTORS, *_SETS))} with its values."
        )
    ((name, values),) = plain.items()
    if name == "not":
        return Not(selector_from(values, f"{where}.not", depth + 1))
    if name in _SETS:
        if not isinstance(values, list) or not values:
            raise EditError(f"{where}.{name} is {_short(values)}.\nExpected a list of selections.")
        parts = tuple(selector_from(value, f"{where}.{name}[{i}]", depth + 1) for i, value in enumerate(values))
        return AnyOf(parts) if name == "any_of" else AllOf(parts)
    kind = SELECTORS[_known(name, (*SELECTORS, *_SETS), where)]
    return _built(kind, {} if values is None else values, f"{where}.{name}")


def plain_operation(operation: Operation, files: Mapping[str, str]) -> dict[str, Any]:
    """Return an edit as plain values; ``files`` names the files that hold its tensors, by the key they stand under."""
    name = next(name for name, kind in OPERATIONS.items() if type(operation) is kind)
    return {"edit": name, **_plain_fields(operation), **files}


def operation_from(plain: Any, where: str, tensors: Mapping[str, Any]) -> Operation:
    """Return the edit that plain values describe; ``tensors`` are constructor arguments read from its files.

    Raises:
        EditError: they describe none.
    """
    if not isinstance(plain, Mapping) or "edit" not in plain:
        raise EditError(f"{where} is {_short(plain)}.\nExpected edit: NAME with NAME one of {', '.join(OPERATIONS)}.")
    values = {key: value for key, value in plain.items() if key not in ("edit", "scene", "points")}
    if isinstance(values.get("rotation"), Mapping):
        turn = values["rotation"]
        if set(turn) != {"axis", "degrees"} or not isinstance(turn["degrees"], int | float):
            raise EditError(f"{where}.rotation is {_short(turn)}.\nExpected [w, x, y, z], or an axis and degrees.")
        values["rotation"] = about_axis(turn["axis"], float(turn["degrees"]))
    if values.get("select") is not None:
        values["select"] = selector_from(values["select"], f"{where}.select")
    kind = OPERATIONS[_known(plain["edit"], tuple(OPERATIONS), where)]
    return _built(kind, {**values, **tensors}, where)


def _plain_fields(thing: Any) -> dict[str, Any]:
    plain = {}
    for item in fields(thing):
        value = getattr(thing, item.name)
        if value is None or (item.default is not MISSING and value == item.default):
            continue
        if isinstance(value, Selector):
            plain[item.name] = plain_selector(value)
        elif isinstance(value, int | float | tuple):
            plain[item.name] = _lists(value)
    return plain


def _lists(value: Any) -> Any:
    return [_lists(part) for part in value] if isinstance(value, tuple) else value


def _built(kind: type, values: Any, where: str) -> Any:
    if not isinstance(values, Mapping):
        raise EditError(f"{where} is {_short(values)}.\nExpected keys and values.")
    known = [item.name for item in fields(kind)]
    for key in values:
        _known(key, known, where)
    missing = [item.name for item in fields(kind) if item.default is MISSING and item.name not in values]
    if missing:
        raise EditError(f"{where} lacks {', '.join(missing)}.")
    try:
        return kind(**values)
    except TypeError as error:  # numbers asked for, something else given
        raise EditError(f"{where} is {_short(dict(values))}.\n{error}") from error


def _known(name: Any, known: Any, where: str) -> str:
    if name in known:
        return str(name)
    near = get_close_matches(str(name), [str(key) for key in known], n=1)
    hint = f"Did you mean {near[0]}?" if near else f"Allowed: {', '.join(known) or 'nothing'}."
    raise EditError(f"{where} has no {_short(name)}.\n{hint}")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
