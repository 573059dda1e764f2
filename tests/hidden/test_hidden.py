"""Hidden effects: a seeded sample in CI; the whole, behind the slow marker, by ``python -m tests.hidden``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.hidden import building_trials, judge, plans, tables, trial, worlds
from tests.hidden.__main__ import main

SEED = 4001 * trial.TRIALS_A_TRUTH
"""The sample shares one truth, so that one calibration does."""
SAMPLE = ((0, "stiffness_change"), (2, "story_damper"), (3, "sensor_gain"), (6, "clean"))


def told(results: list[dict[str, Any]]) -> str:
    return "\n" + "\n".join(tables.line(r) for r in results)


@pytest.mark.engine
@pytest.mark.timeout(1200)
def test_what_is_hidden_is_found() -> None:
    results = [trial.run(SEED + i, name) for i, name in SAMPLE]
    assert all(r["outcome"] in ("right", "among") for r in results), told(results)
    assert all(s["right"] for r in results for s in r["sizes"]), told(results)


@pytest.mark.slow
def test_the_whole() -> None:
    results = [trial.run(seed, name) for seed, name in worlds.rounds(3 * len(plans.NAMES), 7, plans.NAMES)]
    print(tables.report(results))
    single = [r for r in results if r["kind"] == "single"]
    named = [r for r in results if r["answer"]["verdict"] == "named"]
    assert not [r for r in results if r["outcome"] == "crashed"]
    assert sum(r["outcome"] == "right" for r in single) >= 0.8 * len(single)
    assert sum(bool(r["false"]) for r in named) <= 0.05 * len(results)
    sizes = [s["right"] for r in single for s in r["sizes"]]
    assert sum(sizes) >= 0.9 * len(sizes)


def answer(verdict: str, *causes: tuple[str, str], among: tuple[tuple[str, str], ...] = ()) -> dict[str, Any]:
    def item(effect: str, location: str) -> dict[str, Any]:
        return {"effect": effect, "location": location, "parameters": {}, "probability": 0.5}

    alternatives = [{k: v for k, v in item(*a).items() if k != "parameters"} for a in among]
    return {"verdict": verdict, "causes": [item(*c) for c in causes], "alternatives": alternatives}


def sealed(kind: str, *hidden: tuple[str, str]) -> dict[str, Any]:
    items = [{"effect": e, "location": at, "parameters": {"relative": -0.1}} for e, at in hidden]
    return {"kind": kind, "name": "", "hidden": items}


LOSS, BASE, GAIN = ("stiffness_change", "story 3"), ("base_flexibility", "base"), ("sensor_gain", "channel a1")
LOSS_1, LOSS_2 = ("stiffness_change", "story 1"), ("stiffness_change", "story 2")


@pytest.mark.parametrize(
    ("truth", "said", "outcome"),
    [
        (sealed("clean"), answer("none"), "right"),
        (sealed("clean"), answer("named", GAIN), "wrong"),
        (sealed("single", LOSS_1), answer("named", LOSS_1), "right"),
        (sealed("single", LOSS_1), answer("named", LOSS_2), "place"),
        (sealed("single", LOSS_1), answer("named", LOSS_1, GAIN), "extra"),
        (sealed("single", LOSS_1), answer("ambiguous", among=(LOSS_1, GAIN)), "among"),
        (sealed("single", LOSS_1), answer("ambiguous", among=(LOSS_2, GAIN)), "wrong"),
        (sealed("single", LOSS_1), answer("none"), "missed"),
        (sealed("single", LOSS), answer("ambiguous", among=(LOSS, BASE)), "right"),
        (sealed("single", LOSS), answer("ambiguous", among=(BASE, GAIN)), "wrong"),
        (sealed("single", LOSS), answer("named", LOSS), "certain"),
        (sealed("pair", LOSS_1, GAIN), answer("named", GAIN, LOSS_1), "right"),
        (sealed("pair", LOSS_1, GAIN), answer("named", GAIN), "part"),
        (sealed("pair", LOSS_1, GAIN), answer("ambiguous", GAIN, among=(LOSS_1, LOSS_2)), "among"),
        (sealed("outside", LOSS_1), answer("unexplained"), "right"),
        (sealed("outside", LOSS_1), answer("named", LOSS_1), "close"),
        (sealed("outside", LOSS_1), answer("named", LOSS_1, GAIN), "wrong"),
    ],
)
def test_the_judge(truth: dict[str, Any], said: dict[str, Any], outcome: str) -> None:
    assert judge.outcome(truth, said) == outcome


NOISE, LOSS_5 = ("sensor_noise", "channel a1"), ("stiffness_change", "story 5")


@pytest.mark.parametrize(
    ("truth", "said", "outcome"),
    [
        (sealed("artefact"), answer("named", NOISE), "right"),
        (sealed("artefact"), answer("unexplained"), "right"),
        (sealed("artefact"), answer("unexplained", LOSS_1), "wrong"),
        (sealed("artefact"), answer("ambiguous", among=(LOSS_1, NOISE)), "ambiguous"),
        (sealed("artefact", LOSS_1), answer("unexplained", LOSS_1, NOISE), "right"),
        (sealed("artefact", LOSS_1), answer("named", NOISE), "missed"),
        (sealed("artefact", LOSS_1), answer("ambiguous", among=(LOSS_1, NOISE)), "among"),
        (
            {**sealed("artefact", LOSS_5), "lowest": "story 5"},
            answer("ambiguous", NOISE, among=(LOSS_5, BASE)),
            "right",
        ),
        ({**sealed("single", LOSS), "lowest": "story 5"}, answer("named", LOSS), "right"),
    ],
)
def test_the_judge_hears_of_the_structure_alone_beside_an_artefact(
    truth: dict[str, Any], said: dict[str, Any], outcome: str
) -> None:
    assert judge.outcome(truth, said) == outcome


@pytest.mark.parametrize(
    ("truth", "outcome"),
    [
        (sealed("outside", (judge.FAULT, "channel a1")), "right"),
        (sealed("outside", (judge.FAULT, "channel a2")), "wrong"),
        (sealed("single", LOSS_1), "wrong"),
        (sealed("artefact"), "right"),
    ],
)
def test_a_channel_that_is_held_at_fault_must_be(truth: dict[str, Any], outcome: str) -> None:
    said = {**answer("unexplained"), "left_over": [["channel a1", 20.0], ["f = 4.0-5.0 Hz, channel a2", 9.0]]}
    assert judge.outcome(truth, said) == outcome


def test_without_a_baseline_true_modes_alone_may_be_named() -> None:
    truth = {**sealed("uncalibrated"), "modes_hz": [3.0, 7.0]}
    mode = ("unmodelled_mode", "frame")
    said = answer("named", mode)

    def judged(hz: float) -> str:
        said["causes"][0]["parameters"] = {"frequency_hz": {"value": hz, "std": 0.01}}
        return judge.outcome(truth, said)

    assert (judged(3.05), judged(6.9), judged(3.2)) == ("right", "right", "wrong")
    line = answer("ambiguous", among=(("harmonic_excitation", "floor 1"),))
    assert judge.outcome(truth, line) == "wrong"
    assert judge.false_causes(truth, line) == [("harmonic_excitation", "floor 1")]
    assert judge.outcome(truth, answer("none")) == "right"


def test_a_campaign_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, str]] = []

    def run(seed: int, name: str) -> dict[str, Any]:
        asked.append((seed, name))
        seconds = {"calibrate": 0.0, "record": 0.0, "diagnose": 0.0}
        rest = {"answer": answer("none"), "outcome": "right", "false": [], "sizes": [], "seconds": seconds}
        return {"seed": seed, "standing": "", **sealed("clean"), "name": name, **rest}

    monkeypatch.setattr(trial, "run", run)
    for n in ("3", "5"):
        main([n, "--world", "building", "--seed", "9", "--out", str(tmp_path / "all.jsonl")])
    assert asked == worlds.rounds(5, 9, building_trials.NAMES)
    assert len((tmp_path / "all.jsonl").read_text().splitlines()) == 5


def test_sizes_are_judged_by_the_contract() -> None:
    truth = sealed("single", LOSS_1)
    said = answer("named", LOSS_1)

    def judged(value: float, std: float) -> tuple[bool, bool]:
        said["causes"][0]["parameters"] = {"relative": {"value": value, "std": std}}
        (row,) = judge.sizes(truth, said)
        return row["right"], row["covered"]

    assert judged(-0.104, 0.001) == (True, False)
    assert judged(-0.106, 0.001) == (False, False)
    assert judged(-0.106, 0.004) == (True, True)


def test_without_a_baseline_the_stories_are_judged() -> None:
    truth = {**sealed("uncalibrated"), "stories": [0.8, 1.25]}
    fitted = [{"value": 0.81, "std": 0.01}, {"value": 1.4, "std": 0.02}]
    rows = judge.sizes(truth, {**answer("none"), "stories": fitted})
    assert [(row["right"], row["covered"]) for row in rows] == [(True, True), (False, False)]
    assert judge.sizes(truth, {**answer("unexplained"), "stories": fitted}) == []
    assert judge.sizes(truth, {**answer("none"), "stories": []}) == []
