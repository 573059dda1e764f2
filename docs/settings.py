"""docs/settings.py: writes docs/settings.md, every key that a file of ours may hold, from the classes that read it."""

from __future__ import annotations

import ast
import inspect
import textwrap
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel

from drivers.registry import SOURCES, source_type
from monitor.config.configuration import Configuration
from monitor.service.fleet import FleetSettings
from monitor.service.outlets import outlet_of
from monitor.service.outlets.notify import NotifySettings

PAGE = Path(__file__).with_suffix(".md")
_HEAD = """# Settings

Every key of a structure file, a site file and a fleet file; tables with the same keys stand together. A dash: it must be given
where its table is. A key's name ends in its unit; the bounds of its value stand in brackets. `shm-monitor check FILE` refuses
unknown keys and says which are wrong.
What to change, and when: [choosing](choosing.md).
`[topics]` names what it likes: ROS 2 Imu topic = channel, as `"/imu/top" = "a1.x"` ([connect](connect.md)).

(Written by `.venv/bin/python docs/settings.py` from the classes that read the files; a test sees that it is up to date.)
"""


def tables() -> dict[type[BaseModel], list[str]]:
    """Class -> what its tables are called: all that a configuration may hold, and the table of a fleet file."""
    found: dict[type[BaseModel], list[str]] = {}

    def add(path: str, annotation: Any, of_kind: str = "") -> None:
        is_free = not of_kind and dict[str, Any] in (annotation, *get_args(annotation))
        for cls in _free(path) if is_free else _classes(annotation):
            kind = "".join(get_args(cls.model_fields["kind"].annotation)) if "kind" in cls.model_fields else ""
            told = f', `kind = "{kind}"`' if kind else of_kind
            name = f"[[{path}]]" if get_origin(annotation) is tuple else f"[{path}]"
            found.setdefault(cls, []).append(f"`{name}`{told}")
            for key, field in cls.model_fields.items():
                add(f"{path}.{key}", field.annotation, told)

    for key, field in Configuration.model_fields.items():
        add(key, field.annotation)
    add("fleet", FleetSettings)
    found[FleetSettings][0] += " of a fleet file"
    return found


def _classes(annotation: Any) -> list[type[BaseModel]]:
    """The classes of a field's type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [cls for part in get_args(annotation) for cls in _classes(part)]


def _free(path: str) -> list[type[BaseModel]]:
    """Those who read a table that the configuration leaves to them."""
    if path == "source":
        return [source_type(kind).Settings for kind in SOURCES]
    if path == "notify":
        return [NotifySettings]
    assert path.startswith("output."), f"whose is the table {path}?"
    return [outlet_of(path.removeprefix("output."))[1]]


def says(cls: type[BaseModel]) -> dict[str, str]:
    """What stands under each field in the source, those of the bases too."""
    out: dict[str, str] = {}
    for kind in reversed(cls.__mro__[: cls.__mro__.index(BaseModel)]):
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        assert isinstance(node, ast.ClassDef)
        for field, text in zip(node.body, node.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
                out[field.target.id] = " ".join(ast.literal_eval(text.value).split())
    return out


def shown(value: Any) -> str:
    """A default as TOML has it."""
    if value in (None, (), {}, ""):
        return "none"
    if isinstance(value, bool | int):
        return f"`{str(value).lower()}`"
    return f"`{value:g}`" if isinstance(value, float) else f'`"{value}"`'


_BOUNDS = {
    "minimum": "at least {:.10g}",
    "exclusiveMinimum": "above {:.10g}",
    "maximum": "at most {:.10g}",
    "exclusiveMaximum": "below {:.10g}",
    "minLength": "{} or more characters",
    "maxLength": "{} or fewer characters",
    "minItems": "{} or more values",
    "maxItems": "{} or fewer values",
}


def bounds(schema: Any) -> list[str]:
    """The bounds of a value, or of those that it holds, by its JSON schema."""
    if isinstance(schema, list):
        return [text for part in schema for text in bounds(part)]
    if not isinstance(schema, dict):
        return []
    if "minItems" in schema and schema["minItems"] == schema.get("maxItems"):
        schema = {
            key: part for key, part in schema.items() if key not in ("minItems", "maxItems")
        }  # its default shows how many
    own = [text.format(schema[key]) for key, text in _BOUNDS.items() if key in schema]
    return own + [text for part in schema.values() for text in bounds(part)]


def page() -> str:
    """The whole of it."""
    parts = [_HEAD]
    for cls, names in tables().items():
        words, rows, schemas = says(cls), [], cls.model_json_schema()["properties"]
        for name, field in cls.model_fields.items():
            if name == "kind" or isinstance(field.default, BaseModel):
                continue
            required = field.is_required()
            default = "-" if required else shown(field.get_default(call_default_factory=True))
            choices = [f"`{a}`" for a in get_args(field.annotation) if isinstance(a, str)]
            choice = ", ".join(choices or dict.fromkeys(bounds(schemas[name])))
            text = words.get(name, "").replace("``", "`").replace("|", "\\|")
            rows.append(f"| `{name}` | {default} | {' '.join(filter(None, [text, choice and f'({choice})']))} |")
        parts.append(f"## {'; '.join(names)}\n| key | default | |\n|---|---|---|\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
