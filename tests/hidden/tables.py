"""The outcomes of many trials as text."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.hidden.judge import REFIT, key
from tests.hidden.worlds import NAMES

OUTCOMES = (
    "right", "among", "extra", "part", "close", "place", "certain", "wrong", "missed", "unexplained", "ambiguous", "crashed",
)  # fmt: skip


def line(result: dict[str, Any]) -> str:
    """One trial."""
    answer = result["answer"]
    hidden = "; ".join(_cause(h) for h in result["hidden"])
    found = "; ".join(_cause(c) for c in answer["causes"])
    offered = ", ".join(f"{a['effect']} {a['location']} {a['probability']:.2f}" for a in answer["alternatives"][:5])
    seconds = result["seconds"]
    return (
        f"{result['seed']} {result['outcome']:11s} {result['name']} [{hidden}] standing {result['standing']}"
        f" -> {answer['verdict']} [{found}]{' of ' + offered if offered else ''}"
        f" ({seconds['calibrate']} + {seconds['record']} + {seconds['diagnose']} s)"
    )


def _cause(cause: dict[str, Any]) -> str:
    def text(value: Any) -> str:
        return f"{value['value']:.4g} +- {value['std']:.2g}" if isinstance(value, dict) else f"{value:.4g}"

    return " ".join([cause["effect"], cause["location"], *(f"{k}={text(v)}" for k, v in cause["parameters"].items())])


def report(results: Sequence[dict[str, Any]]) -> str:
    """All tables."""
    return "\n\n".join([_outcomes(results), _confusion(results), _sizes(results), _summary(results)])


def _outcomes(results: Sequence[dict[str, Any]]) -> str:
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for r in results:
        counts[r["name"]][r["outcome"]] += 1
    used = [o for o in OUTCOMES if any(c[o] for c in counts.values())]
    rows = [f"{'trial':22s}" + "".join(f"{o:>12s}" for o in used)]
    for name in dict.fromkeys(NAMES):
        if name in counts:
            rows.append(f"{name:22s}" + "".join(f"{counts[name][o] or '.':>12}" for o in used))
    return "\n".join(rows)


def _confusion(results: Sequence[dict[str, Any]]) -> str:
    """The confusion matrix, row by row: what was said of each hidden effect."""
    rows = ["said (@: at the wrong place; |: ambiguous; ?: unexplained, with these causes)"]
    for name in dict.fromkeys(NAMES):
        said = Counter(_said(r) for r in results if r["name"] == name)
        if said:
            rows.append(f"{name:22s}" + "; ".join(f"{what} {n}" for what, n in said.most_common()))
    return "\n".join(rows)


def _said(result: dict[str, Any]) -> str:
    answer, true = result["answer"], {tuple(key(h)) for h in result["hidden"]}

    def word(item: dict[str, Any]) -> str:
        elsewhere = item["effect"] in {e for e, _ in true} and key(item) not in true
        return item["effect"] + ("@" if elsewhere else "")

    stated = [word(c) for c in answer["causes"]]
    if answer["verdict"] == "ambiguous":
        return " + ".join([*stated, "|".join(sorted(word(a) for a in answer["alternatives"]))])
    if answer["verdict"] == "named":
        return " + ".join(stated)
    return answer["verdict"] if not stated else "? " + " + ".join(stated)


def _sizes(results: Sequence[dict[str, Any]]) -> str:
    by: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for r in results:
        for s in r["sizes"]:
            by[s["effect"], s["parameter"]].append(s)
    rows = [
        f"{'size of what was found':48s}{'n':>5s}{'right':>7s}{'covered':>9s}{'|error|':>9s}{'std':>9s}{'z rms':>8s}"
    ]
    for (effect, parameter), found in sorted(by.items()):
        error = np.array([s["error"] for s in found])
        std = np.array([s["std"] for s in found])
        z = np.sqrt(np.mean((error / np.maximum(std, 1e-12)) ** 2))
        rows.append(
            f"{effect + ' ' + parameter:48s}{len(found):5d}{np.mean([s['right'] for s in found]):7.2f}"
            f"{np.mean([s['covered'] for s in found]):9.2f}{np.median(np.abs(error)):9.4f}{np.median(std):9.4f}{z:8.2f}"
        )
    return "\n".join(rows)


def _summary(results: Sequence[dict[str, Any]]) -> str:
    rows = []
    for kind in ("single", "pair", "outside", "clean", "uncalibrated", "artefact"):
        of = [r for r in results if r["kind"] == kind]
        if of:
            right = sum(r["outcome"] == "right" for r in of)
            false = sum(bool(r["false"]) and r["answer"]["verdict"] == "named" for r in of)
            listed = sum(bool(r["false"]) for r in of)
            rows.append(
                f"{kind:12s} {len(of):4d} trials, right {right} ({right / len(of):.1%}), falsely named {false}"
                f" ({false / len(of):.1%}), a false cause stated under any verdict {listed}"
            )
    sizes = [s for r in results for s in r["sizes"] if s["effect"] != REFIT]
    if sizes:
        right, covered = (np.mean([s[k] for s in sizes]) for k in ("right", "covered"))
        rows.append(f"sizes: {len(sizes)}, within tolerance {right:.1%}, within 95 % intervals {covered:.1%}")
    seconds = [r["seconds"]["diagnose"] for r in results]
    rows.append(
        f"diagnosis: median {np.median(seconds):.0f} s, longest {max(seconds):.0f} s" if seconds else "no trials"
    )
    return "\n".join(rows)
