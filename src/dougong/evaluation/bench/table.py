"""The bench's figures as text for a terminal and as Markdown for the docs."""

from collections.abc import Mapping
from typing import Any

Row = Mapping[str, Any]

_ERROR = "displacement_p95_mm"
"""Where an answer has an error, only those that get about as near have done the same work."""
_AS_NEAR, _NEAR_ENOUGH_MM = 2.0, 1.0


def ours_of(group: Row) -> Row | None:
    """Return our row of a group, if it was measured."""
    return next((r for r in group["rows"] if r["is_ours"] and r["is_equal"] and _ok(r)), None)


def fastest_peer(group: Row, key: str = "cpu_s") -> Row | None:
    """Return the peer's row with the least of `key`, of those that do equal work."""
    peers = [row for row in _peers(group) if _gets_as_near(row, ours_of(group))]
    return min(peers, key=lambda row: float(row[key])) if peers else None


def _peers(group: Row) -> list[Row]:
    return [r for r in group["rows"] if not r["is_ours"] and r["is_equal"] and _ok(r)]


def _gets_as_near(row: Row, ours: Row | None) -> bool:
    if ours is None or _ERROR not in ours["answer"]:
        return True
    most = max(_AS_NEAR * ours["answer"][_ERROR], _NEAR_ENOUGH_MM)
    return bool(row["answer"][_ERROR] <= most)


def _nearest_in_words(group: Row) -> str:
    """Return which peer gets nearest, where none gets as near as we do; "none" without peers."""
    ours, peers = ours_of(group), _peers(group)
    if ours is None or not peers:
        return "none"
    best = min(peers, key=lambda row: float(row["answer"][_ERROR]))
    return (
        f"none to {ours['answer'][_ERROR]:.2g} mm; {best['name']} to "
        f"{best['answer'][_ERROR]:.2g} mm in {_seconds(best['cpu_s'])}"
    )


def _ok(row: Row) -> bool:
    return row["failed"] is None


def _answer(row: Row) -> str:
    return ", ".join(f"{key} {value:.6g}" for key, value in row["answer"].items())


def as_text(document: Row) -> str:
    """Return every group as a table, and who is absent."""
    lines: list[str] = []
    for group in document["groups"].values():
        ours = ours_of(group)
        threads = f"{group['threads']} thread{'s' if group['threads'] > 1 else ''}"
        lines.append(f"{group['title']}: {group['points']:,} points, {threads}")
        lines.append(f"  {'':26s}{'CPU s':>9s}{'wall s':>9s}{'MB':>8s}{'ratio':>8s}")
        for row in group["rows"]:
            if not _ok(row):
                lines.append(f"  {row['name']:26s}failed: {row['failed']}")
                continue
            ratio = ""
            if ours is not None and row is not ours and _gets_as_near(row, ours):
                ratio = f"{row['cpu_s'] / max(ours['cpu_s'], 1e-9):.2f}"
            mark = "" if row["is_equal"] else " (not equal work)"
            mark += "" if _gets_as_near(row, ours) else " (not as near)"
            lines.append(
                f"  {row['name']:26s}{row['cpu_s']:9.3f}{row['wall_s']:9.3f}"
                f"{row['bytes'] / 1e6:8.0f}{ratio:>8s}  {_answer(row)}{mark}"
            )
        lines.append("")
    absent = ", ".join(document["absent"]) or "none"
    lines.append("ratio: CPU seconds of theirs / ours, above 1 we are faster. MB: peak beyond the")
    lines.append("points held before (programs: of the whole process).")
    lines.append(f"Absent, not measured: {absent}.")
    return "\n".join(lines)


def as_markdown(document: Row) -> str:
    """Return one line per group: ours beside the fastest peer on equal work."""
    lines = [
        "| work | points | threads | dougong, CPU s | fastest peer, CPU s | ratio CPU "
        "| ratio wall | memory, MB (peer) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for group in document["groups"].values():
        ours = ours_of(group)
        if ours is None:
            continue
        peer = fastest_peer(group)
        left = (
            f"| {group['title']} | {group['points']:,} | {group['threads']} "
            f"| {_seconds(ours['cpu_s'])} |"
        )
        if peer is None:
            lines.append(f"{left} {_nearest_in_words(group)} | | | {ours['bytes'] / 1e6:.0f} |")
            continue
        quick = fastest_peer(group, "wall_s") or peer
        lines.append(
            f"{left} {peer['name']} {_seconds(peer['cpu_s'])} "
            f"| {peer['cpu_s'] / ours['cpu_s']:.2f} | {quick['wall_s'] / ours['wall_s']:.2f} "
            f"| {ours['bytes'] / 1e6:.0f} ({peer['bytes'] / 1e6:.0f}) |"
        )
    machine = document["machine"]
    peers = ", ".join(f"{name} {version}" for name, version in document["peers"].items())
    lines += [
        "",
        f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gb']} GB. {peers}. "
        f"Absent: {', '.join(document['absent']) or 'none'}.",
    ]
    return "\n".join(lines)


def as_markdown_all(document: Row) -> str:
    """Return every contender of every group, with the answer that shows equal work."""
    lines = [
        "| work | points | threads | who | CPU s | wall s | MB | answer |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for group in document["groups"].values():
        left = f"| {group['operation']} | {group['points']:,} | {group['threads']} |"
        for row in group["rows"]:
            if not _ok(row):
                lines.append(f"{left} {row['name']} | failed | | | {row['failed']} |")
                continue
            mark = "" if row["is_equal"] else " (not equal work)"
            lines.append(
                f"{left} {row['name']}{mark} | {_seconds(row['cpu_s'])} "
                f"| {_seconds(row['wall_s'])} | {row['bytes'] / 1e6:.0f} | {_answer(row)} |"
            )
    return "\n".join(lines)


def _seconds(value: float) -> str:
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"
