"""Format the figures of a finished lift and the paths of its files as text for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from ..gates import printable
from ..json_file import Json, read_object
from .folder import LiftFolder
from .manifest import MAKE_ANEW, read_manifest

_SHARES = (("miou", "mIoU %"), ("miou_true", "true %"), ("pq", "PQ %"), ("sq", "SQ %"), ("rq", "RQ %"))
_OTHERS = (
    ("pq_frame", "frame PQ %", 100.0, 1), ("id_changes", "id changes", 1.0, 2), ("psnr", "PSNR dB", 1.0, 2),
    ("psnr_fitted", "fitted", 1.0, 2), ("ssim", "SSIM", 1.0, 3), ("depth_error_m", "depth cm", 100.0, 1),
)  # fmt: skip
_CLASS_SHARES = (("iou", "IoU %"), *_SHARES[2:])
_COUNTS = ("tp", "fp", "fn")
_NO_METRICS = "There are no metrics: they need held-out frames with ground truth."
_LARGEST = 1e15
_MOST_ENTRIES = 5_000  # maximum entries shown of a list; a lift writes hundreds
_SHOWN = ("semantic_points.npz", "instances.json", "gaussians.ply", "metrics.json", "previews", "passes")


def metrics_text(metrics: Mapping[str, Json], *, per_class: bool = False) -> str:
    """Return the tables of a metrics.json as text, with a line for each method and mode and, if ``per_class``, for each
    class. Shares are in per cent, "true %" is mIoU over the classes of the ground truth, "id changes" is how often an
    object changes its id, PSNR is in dB, the median depth error in cm; "fitted" is PSNR after a fit of colours."""
    tables = [table for table in _list(metrics.get("tables")) if isinstance(table, dict)]
    rows = [["", "mode", *(heading for _, heading in _SHARES), *(heading for _, heading, _, _ in _OTHERS)]]
    for table in tables:
        shares = [_number(table.get(key), 100.0, 1) for key, _ in _SHARES]
        rendered = [_number(table.get(key), factor, digits) for key, _, factor, digits in _OTHERS]
        rows.append([str(table.get("name")), str(table.get("mode") or "-"), *shares, *rendered])
    figures = _aligned(rows, left=2) if tables else _NO_METRICS
    missed = [f"Not shown: {text} (see frame {printable(frame)})" for text, frame in not_shown(metrics, together=True)]
    missed += [f"Wrong with the scene: {printable(finding)}" for finding in wrong_with_scene(metrics)]
    parts = [figures, "\n".join(missed), *(_classes_text(tables) if per_class else ())]
    return "\n\n".join(part for part in parts if part)


def wrong_with_scene(metrics: Mapping[str, Json]) -> list[str]:
    """Return sentences on problems that were found in the scene before it was lifted."""
    entries = [entry for entry in _list(metrics.get("findings")) if isinstance(entry, dict)]
    return [f"{entry.get('cause')}: {entry.get('text')}" for entry in entries if entry.get("severity") == "wrong"]


def not_shown(metrics: Mapping[str, Json], *, together: bool = False) -> list[tuple[str, str]]:
    """The objects that the masks show in close-ups and the lift lacks: a text on each, and the frame that shows it best
    as a text. ``together``: one text for all objects of a class that are shown as the same other one."""
    judges = metrics.get("masks_as_judges")
    alike, found = dict[tuple[str, ...], list[tuple[str, str]]](), []
    for row, one in enumerate(_list(judges.get("not_shown")) if isinstance(judges, dict) else []):
        if isinstance(one, dict):
            of = "" if one.get("whole_class") else "one "
            key = of, str(one.get("name")), str(one.get("shown_as") or ""), "" if together else str(row)
            alike.setdefault(key, []).append((_number(one.get("views"), 1, 0), str(one.get("frame"))))
    for (of, name, shown, _), each in alike.items():
        views = sorted({views for views, _ in each}, key=lambda text: (len(text), text))
        of = f"{len(each)} objects of " if each[1:] else of
        what = f"{of}{name}: seen from near in {' to '.join({views[0]: 0, views[-1]: 0})} views"
        found.append((printable(f"{what}, shown as {shown}" if shown else what), each[0][1]))
    return found


def doubt_of_frames(metrics: Mapping[str, Json]) -> dict[str, float]:
    """Return, for each frame that was rendered to score the lift, the probability that its classes are wrong."""
    judges = metrics.get("masks_as_judges")
    entries = judges.get("doubt") if isinstance(judges, dict) else None
    known = entries.items() if isinstance(entries, dict) else ()
    return {name: float(value) for name, value in known if isinstance(value, int | float)}


def _classes_text(tables: Iterable[Mapping[str, Json]]) -> Iterator[str]:
    """Yield a table as text for each method and mode that has figures by class."""
    for table in tables:
        entries = [entry for entry in _list(table.get("per_class")) if isinstance(entry, dict)]
        if entries:
            heading = f"{table.get('name')}, {table.get('mode')}"
            rows = [[heading, *(title for _, title in _CLASS_SHARES), *(key.upper() for key in _COUNTS)]]
            for entry in entries:
                shares = [_number(entry.get(key), 100.0, 1) for key, _ in _CLASS_SHARES]
                rows.append([str(entry.get("name")), *shares, *(_number(entry.get(key), 1, 0) for key in _COUNTS)])
            yield _aligned(rows, left=1)


def made_files(lift: LiftFolder) -> list[Path]:
    """The existing files and folders of the result that a user may want to open."""
    return [path for path in (lift.result_path / name for name in _SHOWN) if path.exists()]


def estimated_text(lift: LiftFolder) -> str:
    """What of a lift's scene was estimated, a line each; "" if nothing. Raises PlgsError for a damaged lift."""
    return "\n".join(printable(f"{line[:1].upper()}{line[1:]}") for line in read_manifest(lift.result_path).estimated)


def read_metrics(lift: LiftFolder) -> dict[str, Json]:
    """The content of metrics.json. Raises PlgsError if it is missing or damaged."""
    return read_object(lift.result_path / "metrics.json", MAKE_ANEW)


def _list(value: Json) -> list[Json]:
    return value[:_MOST_ENTRIES] if isinstance(value, list) else []


def _number(value: Json, factor: float, digits: int) -> str:
    """``value * factor`` as text; a dash if it is no number, or too large for a float, as JSON's integers may be."""
    if not isinstance(value, int | float) or not abs(value) <= _LARGEST:  # "not <=" is true of NaN
        return "-"
    return f"{value * factor:.{digits}f}"


def _aligned(rows: Sequence[Sequence[str]], left: int) -> str:
    """The rows as aligned columns two spaces apart: the first ``left`` ones flush left, the others flush right."""
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = zip(row, widths, strict=True)
        lines.append("  ".join(c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(cells)).rstrip())
    return "\n".join(lines)
