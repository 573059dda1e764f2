"""The worked examples of docs/extend.md do what the page says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers import registry
from drivers.base import SourceContext
from monitor.config import Configuration, configuration
from monitor.core import Level, Skipped
from monitor.diagnosis import in_words
from monitor.model import EFFECTS, Condition, Context, FittedSizes, parse_effect, prior_from_drawing
from monitor.runs import Session
from tests.examples.alarm_log import AlarmLog
from tests.examples.brace_stiffness import BraceStiffness
from tests.examples.cantilever import write_cantilever
from tests.examples.sine_source import SineSource
from tests.support.frames import settings_of
from tests.support.results import alarm, window_result
from tests.support.samples import Cli
from tests.support.site import Daemon


@pytest.fixture
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the entry point does for an installed distribution."""
    monkeypatch.setitem(registry.SOURCES, "sine", "tests.examples.sine_source:SineSource")


@pytest.mark.usefixtures("_registered")
def test_the_driver_feeds_the_daemon(tmp_path: Path, frame_text: str) -> None:
    site = '[source]\nkind = "sine"\nfrequency_hz = 5.0\nduration_s = 40\n[output]\ndir = "out"\n'
    (tmp_path / "site.toml").write_text(site + frame_text)
    Daemon(tmp_path / "site.toml").run()
    assert len((tmp_path / "out/results.jsonl").read_text().splitlines()) == 5
    source = configuration.make_source({"kind": "sine", "frequency_hz": 5.0}, SourceContext(("a1",)))
    assert isinstance(source, SineSource)
    block = source.read(1.0)
    assert abs(np.fft.rfftfreq(200, 1 / 200)[np.abs(np.fft.rfft(block.samples[:, 0])).argmax()] - 5.0) < 0.5


@pytest.mark.usefixtures("_registered")
def test_a_mistake_in_its_table_is_told(tmp_path: Path, frame_text: str, main: Cli) -> None:
    (tmp_path / "site.toml").write_text('[source]\nkind = "sine"\nfrequency_hz = -5.0\n' + frame_text)
    done = main("check", tmp_path / "site.toml")
    assert (done.returncode, "source.frequency_hz" in done.stderr) == (78, True)


def test_the_effect_is_simulated_and_raises_every_frequency(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, frame_text: str, main: Cli
) -> None:
    monkeypatch.setitem(EFFECTS, "brace_stiffness", BraceStiffness)
    (tmp_path / "s.toml").write_text(frame_text)
    plain = settings_of(frame_text).model()
    braced = replace(plain, effects=(parse_effect("brace_stiffness:story 2:stiffness_n_per_m=300"),))
    assert np.all(braced.modes().frequencies_hz > plain.modes().frequencies_hz)
    effect = "brace_stiffness:story 2:stiffness_n_per_m=300"
    done = main("simulate", "--structure", tmp_path / "s.toml", "--out", tmp_path / "r.mcap", "--duration", 5,
                "--rate", 200, "--effect", effect)  # fmt: skip
    assert done.returncode == 0, done.stderr
    context = Context(plain.structure, ("a1", "a2", "a3"), np.eye(3), 200.0)
    still = Condition(*(np.ones(3),) * 4)
    assert BraceStiffness.starts("story 2", context, still)[0].stiffness_n_per_m == pytest.approx(0.05 * 1514.8507)
    with pytest.raises(ValueError, match="above 0"):
        parse_effect("brace_stiffness:story 2:stiffness_n_per_m=-1")


def test_the_effect_brings_its_own_words(monkeypatch: pytest.MonkeyPatch, frame_text: str) -> None:
    monkeypatch.setitem(EFFECTS, "brace_stiffness", BraceStiffness)
    known = prior_from_drawing(settings_of(frame_text).model(), np.full(6, 0.1), 3)
    sizes = {"stiffness_n_per_m": {"value": 300.0, "std": 5.0}}
    told = in_words("brace_stiffness", "story 2", sizes, known)
    assert told == "a brace of 300 ± 10 N/m stiffens story 2"
    plain = super(BraceStiffness, BraceStiffness).sentence(FittedSizes("story 2", sizes, known.model.structure, ""))
    assert plain == "brace stiffness at story 2, stiffness 300 ± 10 N/m", "what an effect without words gets"


def test_the_structure_is_a_cantilever(tmp_path: Path, main: Cli) -> None:
    write_cantilever(tmp_path / "mast.toml", n=8)
    settings: Configuration = configuration.load(tmp_path / "mast.toml")
    hz = settings.model().modes().frequencies_hz
    # Clamped-free beam: f2 / f1 = 6.27; eight lumped masses come within some percent.
    assert 5.5 < hz[1] / hz[0] < 6.5
    stiffer = settings.model().structure.with_stiffness(np.array([990.0, 990.0]))
    ratio = (
        np.linalg.eigvalsh(stiffer.stiffness_matrix())[0]
        / np.linalg.eigvalsh(settings.model().structure.stiffness_matrix())[0]
    )
    assert ratio == pytest.approx(1.1, abs=0.002), "both halves together: all of K"
    assert main("check", tmp_path / "mast.toml").returncode == 0


def test_the_publisher_notes_changes_only(tmp_path: Path, frame_text: str) -> None:
    log = AlarmLog(tmp_path / "alarms.log")
    session = Session(settings_of(frame_text), None, (log,), None, tmp_path)
    assert session.windows == 0
    for k, level in enumerate([Level.NORMAL, Level.ADVISORY, Level.ADVISORY, Level.ALARM, Level.NORMAL]):
        log.window(window_result(k, alarm=alarm(level, f"is {level.value}", stories=(2,))), "")
    log.window(window_result(9, alarm=alarm(Level.ALARM), skipped=Skipped("x")), "")
    assert [s.split()[1] for s in (tmp_path / "alarms.log").read_text().splitlines()] == [
        "advisory:",
        "alarm:",
        "normal:",
    ]
