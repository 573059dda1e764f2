"""OpenAPI document of the endpoints."""

from __future__ import annotations

from typing import Any

from monitor import __version__
from monitor.damage import State
from monitor.publish import SHOWN
from monitor.service.web.snapshots import DEFAULT_LIMIT, FINDING_KEYS, MOST_IN_ANSWER

_Schema = dict[str, Any]
_NUMBER: _Schema = {"type": ["number", "null"]}
_INTEGER: _Schema = {"type": ["integer", "null"]}
_TEXT: _Schema = {"type": ["string", "null"]}
_OBJECT: _Schema = {"type": ["object", "null"]}


def describe(api: str) -> _Schema:
    """Write the OpenAPI document (version 3.1) of the endpoints below the path `api`."""
    paths: _Schema = {
        f"{api}/status": _get("State of the structure and of the monitor; which other endpoints changed.", "Status"),
        f"{api}/windows": _get("Results of windows, oldest first.", "Windows", _range_parameters()),
        f"{api}/events": _get("Latest events (strong motion), newest first.", "Events"),
        f"{api}/findings": _get("Latest findings of diagnoses, newest first.", "Findings"),
        f"{api}/alarms": _get("Latest alarm episodes, and alarms of events, newest first.", "Alarms"),
        f"{api}/sensors": _get("Health of the sensors, the stream, the source and the recorder.", "Sensors"),
    }
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "shm-monitor",
            "version": __version__,
            "description": "Read-only results of one monitor. Times are UTC, ns since 1970; units are SI and stand in the "
            "names. Every answer has an ETag: a request with If-None-Match is answered by 304 while nothing has changed.",
        },
        "paths": paths,
        "components": {"schemas": _schemas(), "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}}},
        "security": [{"token": []}, {}],
    }


def _get(summary: str, schema: str, parameters: list[_Schema] | None = None) -> _Schema:
    content = {"application/json": {"schema": {"$ref": f"#/components/schemas/{schema}"}}}
    answers: _Schema = {
        "200": {"description": summary, "content": content},
        "304": {"description": "Nothing has changed."},
        "401": {"description": "The token is missing or wrong."},
        "403": {"description": "Without a token: asked for under another name than 127.0.0.1 or localhost."},
    }
    if parameters:
        answers["400"] = {"description": "A parameter is out of its range."}
    return {
        "get": {"summary": summary, "operationId": schema.lower(), "parameters": parameters or [], "responses": answers}
    }


def _range_parameters() -> list[_Schema]:
    most = "Largest number of windows; of more, evenly spaced ones are given, the latest among them."
    limit = {"type": "integer", "minimum": 1, "maximum": MOST_IN_ANSWER, "default": DEFAULT_LIMIT}
    return [
        {"name": name, "in": "query", "description": text, "schema": schema}
        for name, text, schema in (
            ("since_ns", "Only windows that end later than this.", {"type": "integer", "minimum": 0}),
            ("limit", most, limit),
        )
    ]


def _schemas() -> _Schema:
    window = {field.key: _said(field.kind.schema, field.meaning) for field in SHOWN}
    window |= {"level": _TEXT, "stories": _list({"type": "integer"}), "changed": _list({"type": "string"})}
    text = {"type": "string"}
    texts = _list(text)
    maybe_window = {"anyOf": [_ref("Window"), {"type": "null"}]}
    status: _Schema = {
        "site": _said(text, "Name of the site."),
        "version": _said(text, "Version of shm-monitor."),
        "begun_ns": _said(
            {"type": "integer"}, "When the page began to be served; another one: `revisions` count anew."
        ),
        "state": {**text, "enum": [state.value for state in State]},
        "headline": _said(text, "The state in one sentence."),
        "doubts": _said(texts, "What else holds."),
        "monitor": {**text, "enum": ["starting", "running", "silent"]},
        "troubles": _said(texts, "Parts that do not work."),
        "t_ns": _said(_INTEGER, "Data until."),
        "data_age_s": _said(_NUMBER, "Since the latest data came, s."),
        "uptime_s": _said(_NUMBER, "Since the start of the monitor, s."),
        "disk_free_bytes": _said(_INTEGER, "Where results go."),
        "windows": _said(_INTEGER, "Number of windows in this run."),
        "skipped": _said(_INTEGER, "Number of those that could not be judged."),
        "alarm": _said(_OBJECT, "The present alarm, as in summary.json."),
        "stories": _said(texts, "Names of the stories."),
        "has_baseline": _said({"type": ["boolean", "null"]}, "Without one there is no alarm."),
        "alarm_loss": _said(_NUMBER, "Loss from which a confirmed one is an alarm."),
        "latest": _said(maybe_window, "The latest window."),
        "judged": _said(maybe_window, "The latest that was not skipped."),
        "revisions": _said(
            {"type": "object", "additionalProperties": {"type": "integer"}},
            "Name of an endpoint: a number that grows when its answer changes.",
        ),
    }
    finding = {key: _INTEGER if key.endswith("_ns") else _TEXT for key in FINDING_KEYS}
    channel = {"channel": {"type": "string"}, "in_use": {"type": "boolean"}, "reason": _TEXT}
    sensors = dict.fromkeys(("stream", "source", "recorder", "refused", "quality"), _OBJECT)
    return {
        "Status": _object(status),
        "Window": {"type": "object", "properties": window, "required": ["t_end_ns", "level", "stories", "skipped"]},
        "Windows": _object({"matched": {"type": "integer"}, "windows": _list(_ref("Window"))}),
        "Event": {"type": "object", "description": "A line of events.jsonl.", "required": ["id", "t_begin_ns"]},
        "Events": _object({"events": _list(_ref("Event"))}),
        "Finding": _object(finding | {"causes": {"type": ["array", "null"]}}),
        "Findings": _object({"findings": _list(_ref("Finding"))}),
        "Alarm": {"type": "object", "description": "An entry of `alarms` in summary.json.", "required": ["level"]},
        "EventAlarm": {
            "type": "object",
            "description": "An entry of `event_alarms` in summary.json.",
            "required": ["id"],
        },
        "Alarms": _object({"alarms": _list(_ref("Alarm")), "event_alarms": _list(_ref("EventAlarm"))}),
        "Channel": _object(channel),
        "Sensors": _object({"channels": _list(_ref("Channel")), "t_ns": _INTEGER, "delay_s": _NUMBER, **sensors}),
    }


def _said(schema: _Schema, text: str) -> _Schema:
    return {**schema, "description": text}


def _object(properties: _Schema) -> _Schema:
    return {"type": "object", "properties": properties, "required": list(properties)}


def _list(items: _Schema) -> _Schema:
    return {"type": "array", "items": items}


def _ref(name: str) -> _Schema:
    return {"$ref": f"#/components/schemas/{name}"}
