"""Optional libraries: those of the distribution, and named where one is missing."""

from __future__ import annotations

import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from monitor.core.extras import EXTRAS, MissingExtraError, import_extra, missing_extra

ROOT = Path(__file__).parents[2]


def test_the_extras_are_those_of_the_distribution_and_one_that_is_missing_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    optional = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (everything,) = optional.pop("all")
    assert Requirement(everything).extras == set(optional) == set(EXTRAS)
    locked = [line for name in ("requirements-dev.in", "requirements.in") for line in (ROOT / name).read_text().split()]
    held = packages_distributions()
    for extra, lines in optional.items():
        assert set(lines) <= set(locked), extra
        named = {name for one in map(Requirement, lines) for name in (one.name, *one.extras)}
        for module in EXTRAS[extra]:
            assert {name.lower() for name in held[module]} & named, f"{extra} adds {module}"
        assert missing_extra(extra) is None, "the tests' environment has all of them"
    monkeypatch.setitem(EXTRAS, "plot", ("matplotlib", "no_such_module"))
    with pytest.raises(MissingExtraError, match=r"plot\(\) needs the extra plot: pip install 'shm-monitor\[plot\]'"):
        import_extra("matplotlib.pyplot", "plot()")
