"""The web page shows what was published, to those who may read it, and asks nothing of the world outside."""

from __future__ import annotations

import gzip
import json
import re
import socket
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from monitor import publish
from monitor.config import configuration, security_check
from monitor.core import utc
from monitor.damage import Assessment, State
from monitor.publish import pack_month
from monitor.service.outlets import make_outlets
from monitor.service.web.application import make_application
from monitor.service.web.outlet import WebPage, read_token
from monitor.service.web.snapshots import Keep, Snapshots, latest_events, latest_windows
from tests.support.asgi import Answer, ask as ask_application
from tests.support.pages import Page
from tests.support.samples import T0_NS, Cli
from tests.support.site import SITE as BARE_SITE, TOKEN
from tests.support.waiting import until

SECOND = 1_000_000_000
PAGES = Path(publish.__file__).parent / "page/files"
ALARM = {"level": "normal", "stories": [], "reason": "no significant loss", "active": {}, "shelved": []}
CHANNEL = {"channel": "a1", "rms_m_s2": 1.0, "peak_m_s2": 3.0, "spikes": 0, "clipped": 0.0, "noise_floor": 1e-4}
HEALTH: dict[str, Any] = {
    "t_ns": T0_NS,
    "stream": {"rate_hz": 100.0, "availability": 1.0},
    "channels": [CHANNEL],
    "source": {"connected": True, "error": ""},
    "recorder": {"recording": False, "detail": "too little free space"},
    "failed": {"Notifier": "refused"},
    "refused": {"blocks": 0, "latest": ""},
    "delay_s": 0.1,
    "uptime_s": 5.0,
    "disk_free_bytes": 1 << 30,
}
FINDING: dict[str, Any] = {"id": "1", "t_ns": T0_NS, "from_ns": T0_NS, "reason": "warning", "verdict": "named"}
FINDING |= {"says": "Softer.", "causes": []}
SUMMARY: dict[str, Any] = {
    "windows": 3,
    "skipped": 1,
    "alarms": [{"level": "alarm", "story": 2, "t_first_ns": T0_NS, "t_last_ns": None, "ddi": 0.1, "ddi_std": 0.01}],
    "alarm": {"level": "alarm", "stories": [2], "active": {"2": "alarm"}},
    "event_alarms": [{"id": "e1", "condition": "active, unacknowledged", "exceeded": ["inspect"], "by": ""}],
    "known": {"names": ["story 1", "story 2"], "has_baseline": True, "alarm_loss": 0.1, "channels": ["a1", "a2"]},
    "findings": [FINDING],
    "quality": {"availability": 1.0, "gaps": 0},
}
EVENT: dict[str, Any] = {"id": "e1", "revision": 0, "t_begin_ns": T0_NS, "t_end_ns": T0_NS + SECOND}
EVENT |= {"verdict": None, "spectrum": {}}


def line(k: int, **changes: Any) -> dict[str, Any]:
    """Window k of a frame of two stories."""
    figures: dict[str, Any] = {
        "frequencies_hz": [5.123456789, 15.0],
        "frequencies_std_hz": [0.01, 0.02],
        "damping_ratio": [0.01, None],
        "model_modes": [1, 2],
        "stiffness_n_per_m": [2000.0, 1500.0],
        "stiffness_std": [5.0, 4.0],
        "ddi": [0.0, 0.1],
        "ddi_std": [0.01, 0.01],
        "channels_left_out": ["a2"],
        "left_out_reasons": ["does not move"],
    }
    return (
        {"window": k, "t_end_ns": T0_NS + k * SECOND, "window_s": 20.0, "alarm": ALARM, "skipped": None}
        | figures
        | changes
    )


def filled() -> Snapshots:
    shown = Snapshots("bench")
    shown.state(Assessment(State.ALARM, "Story 2 lost 10 %.", ("A doubt.",)))
    for k in range(3):
        shown.window(line(k))
    shown.event(EVENT)
    shown.health(HEALTH)
    shown.summary(SUMMARY)
    return shown


Ask = Callable[..., Answer]


def asking(shown: Snapshots, token: str | None = None) -> Ask:
    return partial(ask_application, make_application(shown, token))


def content(ask: Ask, path: str, **fields: str) -> dict[str, Any]:
    status, _, body = ask(path, **fields)
    assert status == 200, body
    return cast(dict[str, Any], json.loads(body))


def problems(value: Any, schema: dict[str, Any], all_schemas: dict[str, Any], where: str = "$") -> list[str]:
    """List where a value is not as its schema (the part of JSON schema that the document uses) says."""
    if "$ref" in schema:
        return problems(value, all_schemas[schema["$ref"].rpartition("/")[2]], all_schemas, where)
    if "anyOf" in schema:
        found = [problems(value, one, all_schemas, where) for one in schema["anyOf"]]
        return [] if [] in found else found[0]
    kinds = schema.get("type", [])
    named = {"array": list, "object": dict, "string": str, "null": type(None), "boolean": bool}
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    fits = {"integer": is_number and isinstance(value, int), "number": is_number}
    fits |= {kind: isinstance(value, known) for kind, known in named.items()}
    if kinds and not any(fits[kind] for kind in ([kinds] if isinstance(kinds, str) else kinds)):
        return [f"{where}: {value!r} is no {kinds}"]
    if isinstance(value, list):
        return [
            p for i, v in enumerate(value) for p in problems(v, schema.get("items", {}), all_schemas, f"{where}[{i}]")
        ]
    if isinstance(value, dict):
        missing = [f"{where}: no {key}" for key in schema.get("required", ()) if key not in value]
        parts = schema.get("properties", {})
        return missing + [
            p for k, v in value.items() for p in problems(v, parts.get(k, {}), all_schemas, f"{where}.{k}")
        ]
    return [f"{where}: {value!r}"] if value not in schema.get("enum", [value]) else []


@pytest.mark.parametrize("shown", [filled(), Snapshots("empty")], ids=["filled", "empty"])
def test_each_endpoint_answers_as_the_openapi_document_says(shown: Snapshots) -> None:
    ask = asking(shown)
    described = content(ask, "/openapi.json")
    assert described["openapi"].startswith("3.1")
    schemas = described["components"]["schemas"]
    assert len(described["paths"]) == 6
    for path, operations in described["paths"].items():
        schema = operations["get"]["responses"]["200"]["content"]["application/json"]["schema"]
        answer = content(ask, path)
        assert problems(answer, schema, schemas) == []
        assert answer.keys() == schemas[schema["$ref"].rpartition("/")[2]]["properties"].keys()
        for one in operations["get"]["parameters"]:
            least = one["schema"]["minimum"]
            assert ask(f"{path}?{one['name']}={least}")[0] == 200
            assert ask(f"{path}?{one['name']}={least - 1}")[0] == 400
    assert problems({"channels": 1}, schemas["Sensors"], schemas), "the check can fail"


def test_the_answers_hold_what_was_published() -> None:
    ask = asking(filled())
    status = content(ask, "/api/v1/status")
    assert (status["state"], status["headline"], status["doubts"]) == ("alarm", "Story 2 lost 10 %.", ["A doubt."])
    assert status["monitor"] == "running"
    assert status["troubles"] == ["recorder: too little free space", "Notifier: refused"]
    assert status["stories"] == ["story 1", "story 2"]
    assert status["latest"]["frequencies_hz"] == [5.12346, 15.0], "six digits"
    assert [w["t_end_ns"] for w in content(ask, "/api/v1/windows")["windows"]] == [T0_NS + k * SECOND for k in range(3)]
    (event,) = content(ask, "/api/v1/events")["events"]
    assert (event["id"], "spectrum" in event) == ("e1", False)
    assert [f["says"] for f in content(ask, "/api/v1/findings")["findings"]] == ["Softer."]
    alarms = content(ask, "/api/v1/alarms")
    assert [a["story"] for a in alarms["alarms"]] == [2]
    assert alarms["event_alarms"] == SUMMARY["event_alarms"]
    channels = content(ask, "/api/v1/sensors")["channels"]
    assert [(c["channel"], c["in_use"], c["reason"]) for c in channels] == [
        ("a1", True, None),
        ("a2", False, "does not move"),
    ]


def test_a_source_that_is_read_to_its_end_is_no_fault() -> None:
    shown = filled()
    for source, says in (({"says": "lost (bus off)"}, ["source: lost (bus off)"]), ({"error": "", "ended": True}, [])):
        shown.health({**HEALTH, "recorder": None, "failed": {}, "source": {"connected": False, **source}})
        ask = asking(shown)
        assert content(ask, "/api/v1/status")["troubles"] == says
    assert content(ask, "/api/v1/sensors")["source"]["ended"] is True
    assert "Source read to its end" in content(ask, "/api/v1/page")["html"]


def test_a_site_without_a_model_and_skipped_windows_are_shown() -> None:
    shown = Snapshots("bench")
    none = dict.fromkeys(("ddi", "ddi_std", "stiffness_n_per_m", "stiffness_std"))
    alarm = {**ALARM, "level": "warning", "changed": ["the shape of mode 2"]}
    shown.window(line(0, **none, alarm=alarm, frequency_change=[-0.01, None], frequency_change_std=[0.002, None]))
    shown.window({"t_end_ns": T0_NS + SECOND, "alarm": ALARM, "skipped": "gap"})
    status = content(asking(shown), "/api/v1/status")
    assert status["latest"]["skipped"] == "gap"
    assert status["judged"]["ddi"] is None
    assert status["judged"]["frequency_change"] == [-0.01, None]
    assert (status["judged"]["level"], status["judged"]["changed"]) == ("warning", ["the shape of mode 2"])


def test_the_page_says_what_was_published_and_runs_nothing_of_it() -> None:
    shown = filled()
    known = {**SUMMARY["known"], "names": ["deck", "<img src=x onerror=alert(1)>"], "misfit": 5.0}
    shown.summary({**SUMMARY, "known": known, "contact": "Ada </script><b>"})
    ask = asking(shown)
    told = content(ask, "/api/v1/page?range_s=86400")
    html = told["html"]
    assert "<img" not in html and "&lt;img src=x onerror=alert(1)&gt;" in html and "Ada &lt;/script&gt;" in html
    order = (
        "alarm</span>",
        "Story 2 lost 10 %.",
        "What to do:",
        "Call:",
        "--story 2",
        "Where, and how much",
        "A doubt.",
    )
    places = [html.index(words) for words in order]
    assert places == sorted(places)
    rows = html[html.index('id="where"') :]
    assert rows.index("&lt;img") < rows.index(">deck<"), "the affected story first"
    assert {"where", "trust", "loss", "modes", "alarms", "findings", "sensors"} <= set(re.findall(r'id="(\w+)"', html))
    again = content(ask, f"/api/v1/page?range_s=86400&charts={told['tag']}")
    assert (again["charts"], again["html"]) == (None, html), "what is drawn is not sent again"
    headers = ask("/api/v1/page?range_s=86400")[1]
    assert ask("/api/v1/page?range_s=86400", If_None_Match=headers["etag"])[::2] == (304, b"")
    shown.finding({**FINDING, "t_ns": T0_NS + SECOND, "says": "Looser."})
    assert "Looser." in content(ask, "/api/v1/page?range_s=86400")["html"]
    for condition, is_asked in (("active, unacknowledged", True), ("active, acknowledged", False)):
        alarm = {**SUMMARY["alarm"], "conditions": {"2": condition}}
        shown.summary({**SUMMARY, "event_alarms": [], "known": known, "alarm": alarm})
        html = content(ask, "/api/v1/page?range_s=86400")["html"]
        assert condition in html and ("Acknowledge:" in html) is is_asked
    assert '<td class="" data-of="state"><span>alarm</span>' in html
    shown.summary({**SUMMARY, "known": known, "alarm": {**SUMMARY["alarm"], "active": {"2": "warning"}}})
    html = content(ask, "/api/v1/page?range_s=86400")["html"]
    assert '<td class="" data-of="state"><span>warning</span>' in html, "the level that it has now"
    shown.summary({"alarms": [{"level": "alarm"}], "known": {"alarm_loss": "much"}})
    assert "Story 2 lost 10 %." in content(ask, "/api/v1/page?range_s=86400")["html"], "whatever an old file says"
    shown.summary({**SUMMARY, "known": known})
    report = Page(ask("/api/v1/report?range_s=86400")[2].decode())
    assert report.state == "alarm" and "Looser." in report.words and report.charts
    assert "<img src=x onerror=alert(1)>" in report.words and "img" not in [tag for tag, _ in report.tags]
    assert [ask(f"/api/v1/{name}?range_s=-1")[0] for name in ("page", "report")] == [400, 400]


def test_what_a_reader_has_is_not_sent_again() -> None:
    shown = filled()
    ask = asking(shown)
    for name in ("status", "windows", "events", "findings", "alarms", "sensors"):
        headers = ask(f"/api/v1/{name}")[1]
        assert ask(f"/api/v1/{name}", If_None_Match=headers["etag"])[::2] == (304, b"")
    before, tag = content(ask, "/api/v1/status")["revisions"], ask("/api/v1/status")[1]["etag"]
    shown.summary(SUMMARY)
    shown.event(EVENT)
    assert content(ask, "/api/v1/status")["revisions"]["findings"] == before["findings"], (
        "the same finding is no change"
    )
    known = ask("/api/v1/status")[1]["etag"]
    shown.finding({**FINDING, "t_ns": T0_NS + SECOND})
    assert ask("/api/v1/status", If_None_Match=known)[0] == 200, "the status tells which answers changed"
    after = content(ask, "/api/v1/status")["revisions"]
    assert after["findings"] > before["findings"]
    assert after["windows"] == before["windows"]
    assert ask("/api/v1/status", If_None_Match=tag)[0] == 200


def test_data_need_the_token_in_the_header_and_pages_hold_none() -> None:
    ask = asking(filled(), TOKEN)
    described = content(ask, "/openapi.json", Host="monitor.example")["paths"]
    for path in (*described, "/api/v1/page", "/api/v1/report"):
        for shown in (None, "Bearer", f"Bearer {TOKEN}x", f"Basic {TOKEN}"):
            code, headers, body = ask(path, **({} if shown is None else {"Authorization": shown}))
            assert (code, headers["www-authenticate"]) == (401, "Bearer")
            assert b"Story" not in body
        assert ask(f"{path}?token={TOKEN}", Cookie=f"token={TOKEN}")[0] == 401, "not in the address, no cookie"
        assert ask(path, Authorization=f"Bearer {TOKEN}", Host="monitor.example")[0] == 200
    assert ask("/", Host="monitor.example")[0] == 200
    assert "set-cookie" not in ask("/")[1]


def test_without_a_token_a_name_from_elsewhere_is_refused() -> None:
    """Else a page from elsewhere could give its name this machine's address, and read."""
    ask = asking(filled())
    for host in ("127.0.0.1", "localhost:8080", "[::1]:8080", "[::1]", "127.0.0.2:1"):
        assert ask("/api/v1/status", Host=host)[0] == 200
    for host in ("evil.example", "evil.example:8080", "", "127.0.0.1.evil.example:8080"):
        assert ask("/api/v1/status", Host=host)[0] == 403


ANSWERS = {
    404: ("/nothing", "/api/v1/", "/api/v1/status/", "/../pyproject.toml", "/%2e%2e/outlet.py"),
    405: ("POST /api/v1/status", "DELETE /api/v1/status"),
    400: tuple(
        f"/api/v1/windows?{query}"
        for query in ("limit=0", "limit=2001", "limit=x", "limit=%C2%B2", "since_ns=-1", "since_ns=" + "9" * 40)
    ),
    200: ("HEAD /api/v1/status", "HEAD /"),
}


@pytest.mark.parametrize("code", ANSWERS)
def test_each_answer_has_its_code_and_the_policy(code: int) -> None:
    for asked in ANSWERS[code]:
        method, _, path = asked.rpartition(" ")
        got, headers, body = asking(filled())(path, method or "GET")
        assert got == code, asked
        assert headers["content-security-policy"].startswith("default-src 'self';")
        assert headers["x-content-type-options"] == "nosniff"
        assert method == "HEAD" or body
        assert code < 400 or "error" in json.loads(body)


def test_the_pages_name_nothing_outside_and_have_no_inline_code() -> None:
    own = [path for path in PAGES.iterdir() if not path.name.startswith("uplot")]
    assert len(own) >= 6
    for path in own:
        text = (
            path.read_text(encoding="utf-8")
            .replace('xmlns="http://www.w3.org/2000/svg"', "")
            .replace("http://HOST:PORT", "")
        )
        assert not re.search(r"https?://|//[a-z]+\.[a-z]", text), path
        if path.suffix == ".html":
            text = re.sub(r"<(style|script)>\{\{ \w+ \}\}", "", text)  # of a report, which is one file
            text = text.replace('<script type="application/json"', "")
            assert not re.search(r"<style|\sstyle=|\son[a-z]+=|<script(?![^>]*\ssrc=)", text), path
    script = (PAGES / "uplot.js").read_text(encoding="utf-8")
    assert set(re.findall(r"https?://[^\s)\"']+", script)) == {"https://github.com/leeoniya/uPlot"}, (
        "in its first comment"
    )
    assert "MIT" in (PAGES / "uplot-LICENSE.txt").read_text(encoding="utf-8")


def test_windows_after_a_time_and_evenly_spaced_ones() -> None:
    shown = Snapshots("bench")
    for k in (1, 0, 2, 3, 3, 4, 5, 6, 7, 8, 9):  # late, and repeated
        shown.window(line(k))
    ask = asking(shown)

    def ends(query: str) -> tuple[int, list[int]]:
        answer = content(ask, f"/api/v1/windows?{query}")
        return answer["matched"], [(w["t_end_ns"] - T0_NS) // SECOND for w in answer["windows"]]

    assert ends("") == (10, list(range(10)))
    assert ends(f"since_ns={T0_NS + 7 * SECOND}") == (2, [8, 9])
    assert ends(f"since_ns={T0_NS + 9 * SECOND}") == (0, [])
    assert ends("limit=1") == (10, [9])
    assert ends("limit=4") == (10, [2, 4, 7, 9])


def test_the_number_of_windows_is_bounded_and_the_past_gets_coarser() -> None:
    shown = Snapshots("bench", keep=Keep(windows=100))
    for k in range(1000):
        shown.window(line(k))
    answer = content(asking(shown), "/api/v1/windows?limit=1000")
    ends = [(w["t_end_ns"] - T0_NS) // SECOND for w in answer["windows"]]
    assert 50 <= len(ends) <= 100
    assert ends[-50:] == list(range(950, 1000))
    assert 0 < ends[0] < 900 and ends == sorted(set(ends)), "it reaches farther back than its number"


def test_events_are_bounded_and_their_highest_revision_counts() -> None:
    shown = Snapshots("bench", keep=Keep(items=3))
    for k in range(5):
        for revision in (None, 1, 0):
            shown.event({**EVENT, "id": f"e{k}", "t_begin_ns": T0_NS + k, "revision": revision})
    events = content(asking(shown), "/api/v1/events")["events"]
    assert [(e["id"], e["revision"]) for e in events] == [("e4", 1), ("e3", 1), ("e2", 1)]


def test_a_monitor_that_went_silent_is_not_normal() -> None:
    now = [0.0]
    shown = Snapshots("bench", lambda: now[0])
    ask = asking(shown)
    shown.state(Assessment(State.NORMAL, "No change."))
    assert content(ask, "/api/v1/status")["monitor"] == "starting"
    shown.health(HEALTH)
    shown.window(line(3))
    tag = ask("/api/v1/status")[1]["etag"]
    now[0] = 61.0
    code, _, body = ask("/api/v1/status", If_None_Match=tag)
    told = json.loads(body)
    assert (code, told["state"], told["monitor"]) == (200, "not_judged", "silent")
    html = content(ask, "/api/v1/page")["html"]
    assert 'class="state not_judged"' in html and f"since {utc(T0_NS + 3 * SECOND, seconds=True)} UTC" in html
    shown.health({**HEALTH, "data_age_s": 12.0})
    assert "the last came 12 s ago." in content(ask, "/api/v1/page")["html"]
    now[0] += 3600.0
    assert "the last came 12 s before the monitor fell silent." in content(ask, "/api/v1/page")["html"]


def test_an_alarm_that_is_over_is_asked_for_until_somebody_acknowledges_it() -> None:
    shown = filled()
    ask = asking(shown)
    shown.state(Assessment(State.NORMAL, "No loss above 2 % in any story."))
    for condition, is_asked in (("returned to normal, unacknowledged", True), ("normal", False)):
        alarm = {"level": "normal", "stories": [], "active": {}, "conditions": {"2": condition}}
        episode = {**SUMMARY["alarms"][0], "t_last_ns": T0_NS + SECOND}
        shown.summary({**SUMMARY, "alarm": alarm, "alarms": [episode], "event_alarms": []})
        html = content(ask, "/api/v1/page")["html"]
        assert 'class="state normal"' in html
        assert ("Acknowledge the alarm of story 2, which is over" in html) is is_asked
        assert ("ack SITE.toml --story 2 --who" in html) is is_asked
        assert ("Nothing needs to be done." in html) is not is_asked


def json_lines(path: Path, rows: list[Any]) -> None:
    path.write_text("".join(row if isinstance(row, str) else json.dumps(row) + "\n" for row in rows))


def test_the_past_is_read_from_the_output_folder(tmp_path: Path) -> None:
    assert list(latest_windows(tmp_path)) == [] == list(latest_events(tmp_path))
    json_lines(tmp_path / "results-2025-12.jsonl", [line(0), line(1)])
    json_lines(tmp_path / "results.jsonl", ["{damaged\n", "[]\n", line(2), '{"t_end_ns": 1', ""])
    json_lines(tmp_path / "events.jsonl", [EVENT, "[]\n", '{"id": 1}\n', "x\n"])
    assert [row["window"] for row in latest_windows(tmp_path)] == [0, 1, 2]
    pack_month(tmp_path / "results-2025-12.jsonl")
    assert [row["window"] for row in latest_windows(tmp_path)] == [0, 1, 2]
    assert [row["id"] for row in latest_events(tmp_path)] == ["e1"]
    (tmp_path / "results-2025-12.jsonl.zst").write_bytes(b"no zst")
    assert [row["window"] for row in latest_windows(tmp_path)] == [2]
    json_lines(tmp_path / "results.jsonl", [line(k) for k in range(50)])
    assert 0 < len(rows := [row["window"] for row in latest_windows(tmp_path, Keep(tail_bytes=2000))]) < 10
    assert rows[-1] == 49, "the end, whole lines of it"
    found = [row["window"] for row in latest_windows(tmp_path, Keep(read=20))]
    assert found == [*range(0, 40, 4), *range(40, 50)]


@pytest.mark.parametrize("text", ["", "short", "two words that are long enough", "ümlaut-ümlaut-ümlaut", "a\nb" * 10])
def test_a_token_that_could_be_guessed_or_not_be_sent_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"token: a token is one word of at least 16 .* openssl rand -hex 24"):
        read_token(path)
    path.write_bytes(b"\xff" * 20)
    with pytest.raises(ValueError, match="it is no text"):
        read_token(path)
    path.write_text(f"{TOKEN}\n")
    assert read_token(path) == TOKEN


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ('web = "0.0.0.0:8080"', r"output.web: all who reach 0.0.0.0:8080 could read without a token; set web_token"),
        ('web = "[::]:8080"', r"output.web: all who reach"),
        ('web = "127.0.0.1:0"\nweb_token_file = "none"', r"output.web_token_file: .*none: No such file"),
        ('web_token_file = "none"', r"without `web` there is no page"),
        ('web = "8080"', r"'8080' is not HOST:PORT"),
    ],
)
def test_a_page_that_all_could_read_is_refused(
    keys: str, words: str, tmp_path: Path, frame_text: str, main: Cli
) -> None:
    path = tmp_path / "site.toml"
    path.write_text(BARE_SITE.replace('dir = "out"', f'dir = "out"\n{keys}') + frame_text)
    for command in ("check", "run"):
        done = main(command, path)
        assert done.returncode == 78
        assert re.search(words, done.stderr), done.stderr
        assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_page_for_others_needs_the_token_and_check_warns_of_the_open_network(tmp_path: Path, frame_text: str) -> None:
    path, token = tmp_path / "site.toml", tmp_path / "web.token"
    token.write_text(TOKEN)
    token.chmod(0o644)
    path.write_text(
        BARE_SITE.replace('dir = "out"', 'dir = "out"\nweb = "0.0.0.0:0"\nweb_token_file = "web.token"') + frame_text
    )
    config = configuration.load(path)
    make_outlets(path, config, dry=True)
    open_network, readable = security_check.warnings(path, config)
    assert "output.web: at 0.0.0.0:0 the token and the results pass unencrypted" in open_network
    assert readable == "output.web_token_file: web.token can be read by everyone: chmod o-r"
    token.chmod(0o600)
    assert len(security_check.warnings(path, config)) == 1


def test_without_the_extra_one_line_names_it(
    tmp_path: Path, frame_text: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "site.toml"
    path.write_text(BARE_SITE.replace('dir = "out"', 'dir = "out"\nweb = "127.0.0.1:0"') + frame_text)
    monkeypatch.setitem(sys.modules, "starlette", None)
    make_outlets(path, configuration.load(path), dry=True)
    assert caplog.messages == ["[output] web is left out: it needs the extra web: pip install 'shm-monitor[web]'"]


@pytest.fixture
def page(tmp_path: Path) -> Iterator[WebPage]:
    json_lines(tmp_path / "results.jsonl", [line(0), line(1)])
    (tmp_path / "summary.json").write_text(json.dumps(SUMMARY))
    one = WebPage("bench", ("127.0.0.1", 0), TOKEN, tmp_path)
    yield one
    one.close(5.0)
    assert not any(thread.name == "http" for thread in threading.enumerate())


def fetch(page: WebPage, path: str, token: str | None = TOKEN) -> dict[str, Any]:
    assert page.url is not None
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    with urllib.request.urlopen(urllib.request.Request(f"{page.url}{path}", headers=headers), timeout=30.0) as answer:
        return cast(dict[str, Any], json.loads(answer.read()))


def test_the_outlet_shows_the_past_and_what_comes(page: WebPage) -> None:
    page.window(cast(Any, None), json.dumps(line(2)))
    page.state(Assessment(State.ALARM, "Story 2 lost 10 %."))
    page.event(cast(Any, SimpleNamespace()), json.dumps(EVENT))
    page.health_line(HEALTH)
    until(lambda: fetch(page, "api/v1/windows")["matched"] == 3, "the past and the present")
    until(lambda: fetch(page, "api/v1/events")["events"], "the event")
    until(lambda: fetch(page, "api/v1/status")["windows"] == 3, "the summary")
    assert fetch(page, "api/v1/status")["state"] == "alarm"
    begun = {"alarms": [{"level": "alarm", "story": 2}], "windows": 4}
    page.summary({**SUMMARY, **begun})  # not read from the disk some ten seconds later
    until(lambda: fetch(page, "api/v1/alarms")["alarms"] == begun["alarms"], "the alarm")
    assert fetch(page, "api/v1/status")["windows"] == 4
    with pytest.raises(urllib.error.HTTPError, match="401"):
        fetch(page, "api/v1/status", None)
    assert (page.failed, page.dropped) == (None, 0)


def test_a_long_answer_is_compressed_in_the_one_thread_of_the_server(page: WebPage) -> None:
    for k in range(600):
        page.window(cast(Any, None), json.dumps(line(k, channels_left_out=["a2"] * 20)))
    until(lambda: fetch(page, "api/v1/windows")["matched"] == 600, "all windows")
    headers = {"Authorization": f"Bearer {TOKEN}", "Accept-Encoding": "gzip"}
    asked = urllib.request.Request(f"{page.url}api/v1/windows?limit=600", headers=headers)
    with urllib.request.urlopen(asked, timeout=30.0) as answer:
        assert answer.headers["content-encoding"] == "gzip"
        assert len(gzip.decompress(answer.read())) > 128 * 1024
    assert not [thread.name for thread in threading.enumerate() if "AnyIO" in thread.name]


def test_a_page_that_hangs_costs_the_main_thread_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on, shown = threading.Event(), list[int]()
    monkeypatch.setattr(Snapshots, "window", lambda _, row: shown.append(row["window"]) if go_on.wait(60.0) else None)
    page = WebPage("bench", ("127.0.0.1", 0), TOKEN, tmp_path, most_waiting=10)
    for k in range(20):
        page.window(cast(Any, None), json.dumps(line(k)))
    assert page.dropped >= 9
    go_on.set()
    until(lambda: shown == list(range(20 - page.dropped)), "it goes on")
    page.close(5.0)


def test_a_port_that_is_taken_is_told_and_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        one = WebPage("bench", ("127.0.0.1", port), None, tmp_path)
        one.health_line(HEALTH)
        assert one.url is None
        assert one.failed is not None and "in use" in one.failed
        assert len(caplog.records) == 1
    one.health_line(HEALTH)
    assert (one.failed, one.url) == (None, f"http://127.0.0.1:{port}/")
    assert capsys.readouterr().err == f"web page at {one.url}\n"
    one.close(5.0)
