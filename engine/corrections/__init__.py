"""What people correct in a lift: typed edits beside its result, and the result after those corrections. `edits` reads
and writes corrections.json, `making` makes edits, `replay` applies them to the objects and points of a result,
`relabelling` says what becomes of every label, and `result` reads result and edits together. The engine and Blender
both import this, so it needs only numpy."""

from __future__ import annotations

from . import making
from .edits import CORRECTIONS, Edit, editing, read_edits
from .proposals import BY_VIEWS, Proposal, Proposals, class_of_parts, entropy_of, entropy_of_views, proposals_of
from .result import CorrectedResult, MadeResult, correct, put_back, read_corrected, replayed, set_undone, undo
