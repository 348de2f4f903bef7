"""Many scenes at once, on this machine or on the workers of a Dask scheduler: lifts, bakes, exports and scores.

Every piece of work is one engine, a process of its own, on a lift folder that all machines see. So a worker may be
killed, hang, or come back: what it did stays, and another one goes on.
"""

from .plan import BatchPlan, SceneJob
from .run import run_batch
from .worker import run_worker

__all__ = ["BatchPlan", "SceneJob", "run_batch", "run_worker"]
