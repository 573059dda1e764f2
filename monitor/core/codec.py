"""One codec for frozen values: dataclasses of numbers, text and arrays as plain JSON values, and back.

The class is the schema.  The shape of an array stands in its type: ``Annotated[Array, "n k"]`` has n rows of k.  A letter is one
length throughout a value and the values in it; ``j+2`` is two more than j.  A number after the shape, or after a number's type,
is exceeded by every value.  Only files are read by shapes: of values that no file holds they are for readers alone, and may be
any expression, as ``2c+2``.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from fractions import Fraction
from functools import cache
from math import isfinite
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")


def encode(value: object, omit: Iterable[str] = ()) -> Any:
    """Convert a value to dicts, lists, numbers and text, without the fields of it that are named in `omit`."""
    tree = to_plain(value, lambda array: array.tolist())
    return tree if not omit else {name: part for name, part in tree.items() if name not in set(omit)}


def decode(
    cls: type[T],
    tree: Any,
    given: Mapping[str, Any] | None = None,
    place: str = "",
    beside: Iterable[str] = (),
    **lengths: int,
) -> T:
    """Build a value, a dataclass, from what `encode` returned; ValueError names the place at which the tree does not fit.

    `given` are fields of the value that the tree does not hold, or that are read apart; `place` is where the tree stands in
    what is read, and `beside` what else the tree may hold.  `lengths` are known from elsewhere, by their letters.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Motion:
    ...     channels: tuple[str, ...]
    ...     covariance: Annotated[np.ndarray, "c c"]
    >>> tree = encode(Motion(("a1",), np.eye(1)))
    >>> decode(Motion, tree).covariance
    array([[1.]])
    >>> decode(Motion, tree, c=2)
    Traceback (most recent call last):
    ...
    ValueError: covariance: 1 values along c, 2 are expected
    """
    if not isinstance(tree, dict):
        raise ValueError(f"{place or cls.__name__}: {str(tree)[:40]!r} is no object")
    given = given or {}
    wanted = {name: hint for name, hint in _hints(cls).items() if name not in given}  # type: ignore[arg-type]
    at = f"{place}." if place else ""
    if missing := wanted.keys() - tree.keys():
        raise ValueError(f"{at}{min(missing)} is missing")
    if unknown := tree.keys() - wanted.keys() - given.keys() - set(beside):
        raise ValueError(f"{at}{min(unknown)} is not known")
    return cls(**_fields(wanted, tree, place, dict(lengths), _array), **given)


def to_plain(value: object, array: Callable[[np.ndarray], Any]) -> Any:
    """Convert a value to dicts, lists, numbers and text, and what `array` makes of an array.

    Raises TypeError if a part of the value has a type that cannot be kept.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name), array) for f in fields(value) if f.init}
    if isinstance(value, dict):
        if all(type(key) is str for key in value):
            return {key: to_plain(part, array) for key, part in value.items()}
        return [[to_plain(key, array), to_plain(part, array)] for key, part in value.items()]
    if isinstance(value, list | tuple):
        return [to_plain(part, array) for part in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Fraction):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return array(value)
    if value is None or isinstance(value, str | int | float):
        return value
    raise TypeError(f"cannot be kept: {type(value).__name__}")


Arrays = Callable[[Any, tuple[Any, ...], str, dict[str, int]], Any]


def from_plain(hint: Any, tree: Any, array: Arrays, place: str = "", lengths: dict[str, int] | None = None) -> Any:
    """Build a value of the type `hint` from its plain form; the inverse of `to_plain`.

    `array` makes an array of its plain form, the notes on its type, its place and the lengths known so far.  Raises ValueError if
    the tree does not fit the type.
    """
    lengths = {} if lengths is None else lengths
    hint, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    origin, arguments = get_origin(hint), get_args(hint)
    if is_dataclass(hint) and isinstance(hint, type):
        wanted = _hints(hint)
        if not isinstance(tree, dict) or tree.keys() != wanted.keys():
            raise ValueError(f"{place or hint.__name__}: a {hint.__name__} has other fields")
        return hint(**_fields(wanted, tree, place, dict(lengths), array))
    if origin in (Union, types.UnionType):
        if tree is None and type(None) in arguments:
            return None
        kinds = [a for a in arguments if a is not type(None)]
        kind = next((a for a in kinds if a is type(tree)), kinds[0])  # a number or a name
        return from_plain(Annotated[kind, *notes] if notes else kind, tree, array, place, lengths)
    if hint is np.ndarray or origin is np.ndarray:
        return array(tree, tuple(notes), place, lengths)
    if origin in (tuple, list, dict):
        return _collection(origin, arguments, tree, array, place, lengths)
    return _scalar(hint, tree, place, notes, finite=array is _array)


def _scalar(hint: Any, tree: Any, place: str, notes: list[Any], *, finite: bool) -> Any:
    """Build a number, a text, a fraction or a member of an enumeration; every number is above the notes."""
    if hint is Any:
        return tree
    if get_origin(hint) is Literal:
        if tree not in get_args(hint):
            raise ValueError(f"{place}: {str(tree)[:40]!r} is none of {', '.join(map(str, get_args(hint)))}")
        return tree
    if hint is Fraction or (isinstance(hint, type) and issubclass(hint, Enum)):
        return hint(_checked(tree, str, place))
    value = _checked(tree, (float, int) if hint is float else hint, place)
    if finite and hint is float and not isfinite(value):
        raise ValueError(f"{place}: {value} is not finite")
    for least in notes:
        if not value > least:
            raise ValueError(f"{place}: {value} is not above {least:g}")
    return value


def _fields(
    wanted: Mapping[str, Any], tree: Mapping[str, Any], place: str, lengths: dict[str, int], array: Arrays
) -> dict[str, Any]:
    """Build the fields of a dataclass; all of them share their lengths."""
    before = f"{place}." if place else ""
    return {name: from_plain(hint, tree[name], array, before + name, lengths) for name, hint in wanted.items()}


def _collection(
    origin: Any, arguments: tuple[Any, ...], tree: Any, array: Arrays, place: str, lengths: dict[str, int]
) -> Any:
    """Build a tuple, a list or a dict."""
    if origin is dict and isinstance(tree, dict):
        return {
            from_plain(arguments[0], key, array, place, lengths): from_plain(
                arguments[1], part, array, f"{place}.{key}", lengths
            )
            for key, part in tree.items()
        }
    items = _checked(tree, list, place)
    if origin is dict:
        return dict(_collection(tuple, arguments, pair, array, place, lengths) for pair in items)
    if origin is tuple and arguments[-1] is not Ellipsis:
        if len(items) != len(arguments):
            raise ValueError(f"{place}: {len(items)} values, {len(arguments)} are expected")
        kinds = arguments
    else:
        kinds = (arguments[0],) * len(items)
    return origin(
        from_plain(kind, item, array, f"{place}[{k}]", lengths)
        for k, (kind, item) in enumerate(zip(kinds, items, strict=True))
    )


def _array(tree: Any, notes: tuple[Any, ...], place: str, lengths: dict[str, int]) -> np.ndarray:
    """Make an array of nested lists of finite numbers, of the shape that its type states."""
    shape, *least = notes or (None,)
    try:
        values = np.array(tree)
    except ValueError as error:
        raise ValueError(f"{place}: its rows are of different lengths") from error
    if values.size and values.dtype.kind not in "iuf":
        raise ValueError(f"{place}: not all values are numbers")
    values = values.astype(float)
    if not np.isfinite(values).all():
        raise ValueError(f"{place}: not all values are finite")
    if least and not (values > least[0]).all():
        raise ValueError(f"{place}: not all values are above {least[0]:g}")
    if shape is None:
        return values
    axes = [axis.split("+") for axis in shape.split()]
    if not values.size:
        values = values.reshape([0 if k == 0 else lengths.get(name, 0) for k, (name, *_) in enumerate(axes)])
    if values.ndim != len(axes):
        raise ValueError(f"{place}: {values.ndim} axes, {len(axes)} are expected")
    for (name, *more), n in zip(axes, values.shape, strict=True):
        extra = int(more[0]) if more else 0
        wanted = int(name) if name.isdecimal() else lengths.setdefault(name, n - extra) + extra
        if n != wanted:
            raise ValueError(f"{place}: {n} values along {'+'.join((name, *more))}, {wanted} are expected")
    return values


def _checked(tree: Any, kind: Any, place: str) -> Any:
    """Return the value if it has the type `kind`, else raise ValueError; a bool is no number."""
    if not isinstance(tree, kind) or (isinstance(tree, bool) and kind is not bool):
        raise ValueError(f"{place}: {str(tree)[:40]!r} is no {getattr(kind, '__name__', 'number')}")
    return tree


@cache
def _hints(cls: type) -> dict[str, Any]:
    """Return the types of the fields that the constructor of a dataclass takes, by name."""
    hints = get_type_hints(cls, include_extras=True)
    return {f.name: hints[f.name] for f in fields(cls) if f.init}
