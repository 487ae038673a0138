"""Earth-moving tasks and their measures. The same as `jaxsand.goals.tasks`."""

from jaxsand.goals.tasks import (
    TASKS,
    Task,
    figures,
    make_task,
)

__all__ = [
    "TASKS",
    "Task",
    "figures",
    "make_task",
]
