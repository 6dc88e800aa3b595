"""What a report says first: the verdict, and what is known of the accuracy."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from dougong._words import counted

Tone = Literal["good", "unsure", "bad"]
TONES: dict[str, Tone] = {"ok": "good", "ambiguous": "unsure", "failed": "bad"}
WORDS: dict[Tone, str] = {"good": "Registered", "unsure": "Ambiguous", "bad": "Not registered"}
NO_CHECKS = (
    "No independent check points were given: no accuracy grade is stated (no USIBD level of "
    "accuracy, LOA). The numbers on this page say how well the clouds fit each other, not how "
    "well they fit the world."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The first thing a reader sees."""

    tone: Tone
    word: str
    sentence: str


def run_verdict(result: Mapping[str, Any], demo: Mapping[str, Any] | None) -> Verdict:
    """Return the verdict on a whole run, in words for people who sign it."""
    documents = result["registrations"]
    tone = TONES[result["status"]]
    if not documents:
        words = "One cloud was given, so it was filtered; there was nothing to register."
        return Verdict(tone="good", word="Filtered", sentence=words)
    sure = sum(document["status"] == "ok" for document in documents)
    if demo is not None and demo["tre95_m"] is not None:
        words = (
            f"The pose lies {1000 * demo['tre95_m']:.1f} mm from the truth (95 % of the surface): "
            f"{demo['verdict']}. {_left(documents[0])}"
        ).strip()
    elif len(documents) == 1:
        words = plain(documents[0])
    else:
        words = f"{sure} of {len(documents)} clouds were registered with certainty."
    if tone != "good":
        words += f" The merged cloud holds only: {', '.join(result['merged']['clouds'])}."
    return Verdict(tone=tone, word=WORDS[tone], sentence=words)


def sentence(text: str) -> str:
    """Return `text` with a capital at its start and a stop at its end."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def plain(document: Mapping[str, Any]) -> str:
    """Return the verdict on one registration in words for people who sign it."""
    left = _left(document)
    if document["status"] != "ok" or not left:
        return sentence(document["reason"])
    return (
        f"{document['source']} fits {document['target']} at one pose, and at none of the others "
        f"that were searched for. {left}"
    )


def _left(document: Mapping[str, Any]) -> str:
    """Return what the registration leaves, in one sentence; empty where it was not measured."""
    return str((document.get("distances") or {}).get("sentence", ""))


def accuracy(
    documents: Sequence[Mapping[str, Any]], quality: Mapping[str, Any] | None
) -> tuple[str, ...]:
    """Return what check points prove, one sentence per registration, or that none were given."""
    said = [_proved(d["source"], d["checks"]) for d in documents if _has_check_points(d)]
    said = said or [NO_CHECKS]
    if quality is not None and quality["required_level"] is not None:
        is_reached = "is" if quality["is_reached"] else "is NOT"
        said.append(f"The required level, {quality['required_level']}, {is_reached} reached.")
    return tuple(said)


def _has_check_points(document: Mapping[str, Any]) -> bool:
    return bool((document.get("checks") or {}).get("check_points"))


def _proved(source: str, checks: Mapping[str, Any]) -> str:
    """Return what the check points of a registration prove."""
    check = checks["check"]
    points = counted(checks["check_points"], "check point")
    if check is None:
        return (
            f"{source}: {points} had no pose to be measured at, so no accuracy grade is stated "
            "(no USIBD level of accuracy, LOA)."
        )
    level = check["level"] or "coarser than LOA10"
    return (
        f"{source}: {points} that had no part in the fit lie "
        f"{millimetres(check['check_rmse_m'])} (check RMSE, three dimensions) from their "
        f"places; with 95 % confidence 95 % of the errors are below "
        f"{millimetres(check['upper95_m'])}: {level} (USIBD)."
    )


def millimetres(metres: float | None) -> str:
    """Return a length in millimetres, a dash where there is none."""
    return "-" if metres is None else f"{1000 * metres:.1f} mm"
