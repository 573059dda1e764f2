"""Coverage of the intervals of a diagnosis' sizes, on pairs of a healthy and a changed record.

    .venv/bin/python -m tests.diagnosis.coverage FILE.jsonl [N] [--seed S] [--kinds loss,mass,gain] [--given]

Each of the N structures has a healthy record, from which its baseline is learned, and for each kind a changed record with a
place and a size of its own; all records have 600 s and 5 % noise.  Of four structures two are the paper's frame and one is
the frame of `recordings/frame-truth.toml`, whose joints rotate, all by the project's simulator; the fourth is by the
independent simulator of `tests/hidden`.  FILE has a JSON line a diagnosis; those that it already holds are not made again,
so that an interrupted run goes on.  With N = 0 the table of FILE alone is printed.  With `--given` effect and place are given
and fitted without a search, which takes a fifth of the time: a cause that the search names alone has this size and interval.
"""

from __future__ import annotations

import argparse
import json
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom
from threadpoolctl import threadpool_limits

from drivers.base import ACCELERATION, SampleBlock
from monitor.config import Configuration
from monitor.diagnosis.score_test import fit_candidate
from monitor.diagnosis.simulation_refit import fit_initial_model
from monitor.diagnosis.verdict import Cause, FittedCauses, describe_effects
from monitor.inference import Segments, classify, gather
from monitor.model import EFFECTS, Effect, StructuralPrior, simulate
from monitor.runs import cut_into_blocks, diagnose
from tests.hidden import truth, world

KINDS = {"loss": ("stiffness_change", "relative"), "mass": ("added_mass", "mass_kg"), "gain": ("sensor_gain", "gain")}
"""Effect and parameter of every kind."""
DURATION_S, RATE_HZ, NOISE, LEVEL_SPREAD = 600.0, 128.0, 0.05, 0.35
CONFIDENT_STDS = 1.959964
"""Half width of a 95 % interval. [standard deviations; definition]"""
_FRAME = Path(__file__).parents[2] / "recordings" / "frame-truth.toml"


@dataclass(frozen=True)
class Change:
    """What a changed record has: one effect at a place."""

    kind: str
    place: int
    """Index of story, floor or channel."""
    share: float
    """Share of the story's stiffness, of the floor's mass, or of the channel's motion; a loss is negative."""

    @property
    def location(self) -> str:
        """Name of the place."""
        return f"{ {'loss': 'story ', 'mass': 'floor ', 'gain': 'channel a'}[self.kind] }{self.place + 1}"

    def size(self, masses_kg: np.ndarray) -> float:
        """Value of the effect's parameter."""
        return {"loss": self.share, "mass": self.share * float(masses_kg[self.place]), "gain": 1.0 + self.share}[
            self.kind
        ]


def draw_change(kind: str, rng: np.random.Generator) -> Change:
    """Draw place and size: a loss of 3 to 15 %, a mass of 4 to 12 % of its floor, a gain off by 4 to 10 %."""
    place = int(rng.integers(3))
    low, high = {"loss": (-0.15, -0.03), "mass": (0.04, 0.12), "gain": (0.04, 0.10)}[kind]
    sign = float(rng.choice([-1.0, 1.0])) if kind == "gain" else 1.0
    return Change(kind, place, sign * float(rng.uniform(low, high)))


@dataclass(frozen=True, eq=False)
class Site:
    """A structure with its drawing."""

    simulator: str
    drawing: Configuration
    masses_kg: np.ndarray
    record: Callable[[Change | None, int], list[SampleBlock]]
    """Blocks of a record with a change and a seed; no change is the healthy structure."""


def own_site(rng: np.random.Generator, *, joints: bool) -> Site:
    """The frame of the recordings, its joints rigid or not, and a drawing off by 5 % in every mass, 10 % in every story."""
    table = tomllib.loads(_FRAME.read_text())
    if not joints:
        del table["effects"]
    actual = Configuration.model_validate(table)
    masses, stories = (np.array(table["structure"][key]) for key in ("masses_kg", "stiffness_n_per_m"))
    drawn = {
        "masses_kg": (masses * np.exp(0.05 * rng.standard_normal(3))).tolist(),
        "stiffness_n_per_m": (stories * np.exp(0.10 * rng.standard_normal(3))).tolist(),
    }
    drawing = Configuration.model_validate({"structure": table["structure"] | drawn, "sensors": table["sensors"]})

    def record(change: Change | None, seed: int) -> list[SampleBlock]:
        model = actual.model()
        if change is not None:
            name, parameter = KINDS[change.kind]
            effect = EFFECTS[name].create(change.location, {parameter: change.size(masses)})
            model = replace(model, effects=(*model.effects, effect))
        motion = simulate(
            model, duration_s=DURATION_S, rate_hz=RATE_HZ, noise=NOISE, level_spread=LEVEL_SPREAD, seed=seed
        )
        return list(cut_into_blocks(ACCELERATION, motion.floors, actual.channels, RATE_HZ, 0, 10_000))

    return Site("own, joints rotate" if joints else "own", drawing, masses, record)


def independent_site(number: int) -> Site:
    """A frame of the independent simulator, with its drawing."""
    actual = truth.draw_truth(number)

    def record(change: Change | None, seed: int) -> list[SampleBlock]:
        act, motion = truth.healthy(actual, seed)
        site, frame = truth.Site(actual, motion, act, np.random.default_rng(seed), DURATION_S), actual.frame
        if change is not None:
            one = change.share * np.eye(3)[change.place]
            if change.kind == "loss":
                act = site.matrices(replace(frame, stories=frame.stories * (1.0 + one)))
            elif change.kind == "mass":
                act = site.matrices(replace(frame, masses=frame.masses * (1.0 + one)))
            else:
                act = replace(act, gain=act.gain * (1.0 + one))
        return world.blocks(world.record(act, DURATION_S, seed))

    drawing = Configuration.model_validate(tomllib.loads(actual.drawing()))
    return Site("independent", drawing, actual.frame.masses, record)


def make_site(number: int, seed: int) -> Site:
    """The structure of a number: two of four are the paper's frame, one has joints that rotate, one is independent."""
    if number % 4 == 3:
        return independent_site(100_000 * seed + number)
    return own_site(np.random.default_rng([seed, number, 0]), joints=number % 4 == 2)


def search(segments: Segments, prior: StructuralPrior, drawing: Configuration) -> tuple[str, tuple[Cause, ...]]:
    """Diagnose as `diagnose` does."""
    found, _ = diagnose.diagnose_segments(segments, prior, drawing)
    return found.verdict, found.causes


def fit_given(
    segments: Segments, prior: StructuralPrior, drawing: Configuration, effect: Effect
) -> tuple[str, tuple[Cause, ...]]:
    """Fit an effect without a search, in place of a verdict `given`."""
    context = drawing.instrumented().context(segments.rate_hz)
    posterior, null_fit, _ = fit_initial_model(classify(segments), prior, context)
    found = fit_candidate(posterior, null_fit, effect)
    return "given", describe_effects(FittedCauses(posterior, found.fit, 1, np.zeros(found.fit.n_effect)), 1.0)


def diagnose_site(number: int, seed: int, kinds: tuple[str, ...], *, given: bool = False) -> Iterator[dict[str, Any]]:
    """Diagnose a record of each kind against one baseline; one row a diagnosis."""
    site = make_site(number, seed)
    first, *others = (int(s) for s in np.random.SeedSequence([seed, number]).generate_state(1 + len(KINDS)))

    @cache
    def baseline() -> StructuralPrior:
        segments = gather(site.record(None, first), site.drawing.front_end())
        return diagnose.learn_healthy_prior(segments, site.drawing)

    for (kind, (effect, parameter)), own in zip(KINDS.items(), others, strict=True):
        if kind not in kinds:
            continue
        began = time.perf_counter()
        change = draw_change(kind, np.random.default_rng([seed, number, own]))
        size = change.size(site.masses_kg)
        segments = gather(site.record(change, own), site.drawing.front_end())
        data = segments, baseline(), site.drawing
        near = replace(change, share=0.9 * change.share).size(site.masses_kg)
        start = EFFECTS[effect].create(change.location, {parameter: near})
        verdict, causes = fit_given(*data, start) if given else search(*data)
        row = {
            "number": number,
            "simulator": site.simulator,
            "kind": kind,
            "location": change.location,
            "truth": size,
            "verdict": verdict,
            "causes": [[c.effect.name, c.effect.location] for c in causes],
            "standing": [[e.name, e.location] for e in baseline().model.effects],
        }
        for c in causes:
            if (c.effect.name, c.effect.location) == (effect, change.location):
                value, std = float(getattr(c.effect, parameter)), c.std[parameter]
                row |= {"size": value, "std": std, "z": (value - size) / std}
        yield row | {"seconds": round(time.perf_counter() - began, 1)}


@dataclass(frozen=True)
class Coverage:
    """Share of 95 % intervals that hold the truth."""

    searched: int
    """Diagnoses with a search."""
    named: int
    """Those that name the effect at its place and nothing else."""
    z: np.ndarray
    """Error over stated standard deviation of every stated size, shape (n,)."""

    @classmethod
    def of(cls, rows: list[dict[str, Any]]) -> Coverage:
        """Count the rows of one kind."""
        named = sum(r["verdict"] == "named" and "z" in r and len(r["causes"]) == 1 for r in rows)
        return cls(sum(r["verdict"] != "given" for r in rows), named, np.array([r["z"] for r in rows if "z" in r]))

    @property
    def held(self) -> int:
        """Number of 95 % intervals that hold the truth."""
        return int((np.abs(self.z) < CONFIDENT_STDS).sum())

    @property
    def likely(self) -> tuple[int, int]:
        """Numbers between which `held` lies with 99 % if 95 % of the intervals hold."""
        low, high = binom.interval(0.99, self.z.size, 0.95)
        return int(low), int(high)


def report(rows: list[dict[str, Any]]) -> str:
    """A line for every kind, and for every kind and simulator."""
    lines = [f"{'':<26} named     95 % hold   (99 % of chance)   RMS z   mean z   |z| at most"]
    for kind in KINDS:
        of_kind = [r for r in rows if r["kind"] == kind]
        for simulator in ("", *sorted({r["simulator"] for r in of_kind})):
            c = Coverage.of([r for r in of_kind if simulator in ("", r["simulator"])])
            if c.z.size:
                low, high = c.likely
                lines.append(
                    f"{kind if not simulator else '  ' + simulator:<26}{c.named:>4} of {c.searched:<4}{c.held:>4} of "
                    f"{c.z.size:<4}({low} to {high})".ljust(67)
                    + f"{np.sqrt((c.z**2).mean()):>5.2f}{c.z.mean():>9.2f}{np.abs(c.z).max():>10.1f}"
                )
    return "\n".join(lines)


def main() -> None:
    """Diagnose what FILE does not hold yet, then print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.diagnosis.coverage", description=__doc__)
    parser.add_argument("file", type=Path, help="JSON lines, one a diagnosis; is added to")
    parser.add_argument("n", type=int, nargs="?", default=100, help="structures, each with a record of every kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--given", action="store_true", help="effect and place are given: no search")
    options = parser.parse_args()
    rows = [json.loads(line) for line in options.file.read_text().splitlines()] if options.file.exists() else []
    done = {(r["number"], r["kind"]) for r in rows}
    for number in range(options.n):
        missing = tuple(kind for kind in options.kinds.split(",") if (number, kind) not in done)
        with threadpool_limits(limits=1), options.file.open("a") as out:
            for row in diagnose_site(number, options.seed, missing, given=options.given) if missing else ():
                rows.append(row)
                out.write(json.dumps(row) + "\n")
                out.flush()
    print(report(rows))


if __name__ == "__main__":
    main()
