"""What the commands do, once their arguments are read; a file for each."""

from jaxsand.cli.bench import run_benchmark
from jaxsand.cli.plan import run_plan
from jaxsand.cli.settle import SCHEMES, run_settle
from jaxsand.cli.shape import run_shape
from jaxsand.cli.trench import run_trench

__all__ = ["SCHEMES", "run_benchmark", "run_plan", "run_settle", "run_shape", "run_trench"]
