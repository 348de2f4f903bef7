"""Rows and results that tests of the tables share."""

from research.experiments.rows import Cited, Row, Rows
from research.results import Figures, Result, this_engine

ROWS = Rows(
    (
        Row("ours", "systems"),
        Row("input masks", "systems", method="input masks"),
        Row("theirs", "systems", {"objects": "boxes"}, paper=Cited("Replica", 71.2, 57.8, 36.6)),
        Row("elsewhere", "systems", paper=Cited("ScanNet", pq=62.3), is_cited=True),
        Row("all of it", "parts", same_as="theirs", paper=Cited("Replica", note="failed")),
        Row("without depth", "parts", {"weights.depth": 0.0}),
        Row("other masks", "parts", masks="other.json"),
        Row("no sensor", "depths", depth_from="without depth"),
    ),
    {"systems": "Systems", "parts": "Its parts", "depths": "Depths"},
)
OFFICE = (
    Result("office", "ours", "preview", 500, 0, this_engine(), Figures(
        0.8, 0.85, 0.7, 0.81, 0.86, 0.71, 0.75, 0.125, 27.0, 28.5, 0.875, 0.0234, 161.6, 1.26e9, 3.25
    )),
    Result("office", "input masks", "-", 0, 0, this_engine(), Figures(0.5, 0.55, 0.25, 0.51, 0.56, 0.26, 0.4, 3.5)),
    Result("office", "theirs", "preview", 500, 0, this_engine(), Figures(0.6, pq=0.5)),
)  # fmt: skip
KITCHEN_FIGURES = Figures(psnr=17.0, psnr_fitted=21.0, seconds=99.5)
KITCHEN = Result("kitchen", "ours", "preview", 500, 0, this_engine(), KITCHEN_FIGURES)
