"""What the commands do, once their arguments are read; a file for each."""

from jaxsand.commands.bench import run_benchmark
from jaxsand.commands.plan import run_plan
from jaxsand.commands.settle import SCHEMES, run_settle
from jaxsand.commands.shape import run_shape
from jaxsand.commands.trench import run_trench

__all__ = ["SCHEMES", "run_benchmark", "run_plan", "run_settle", "run_shape", "run_trench"]
