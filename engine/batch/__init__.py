"""Process many scenes at once, on this machine or on the workers of a Dask scheduler: lifts, bakes, exports and scores.
Every piece of work is one engine, in its own process, on a lift folder that all machines can see. So a worker may be
killed, hang, or come back: its progress is kept, and another worker continues."""

from .cluster import run_worker
from .plan import BatchPlan, SceneJob
from .run import run_batch
