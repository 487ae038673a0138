"""The command line of the learners: `python -m train --help`. Wrong arguments end as those of `jaxsand` do."""

import argparse
import math
import sys

from jaxsand.cli.arguments import Parser, count, draw_without_a_screen, ended, keep_compiled_programs, path_name, seed, width
from train.commands import MINUTES, SHIPPED, run_evaluation, run_export, run_shipping, run_training

_STEPS = {
    "hindsight": "chunks of lessons",
    "dqn": "chunks: steps in all its environments, then updates",
    "actor-critic": "chunks: two episodes for each of 16 goals, then updates",
    "ddpg": "chunks: an episode in each of its 64 environments, then updates",
}
_ABOUT = {
    "hindsight": "the policy that jaxsand ships: which of random strokes are still to come",
    "dqn": "the single stroke on maps",
    "actor-critic": "strokes by reward: an actor-critic of DDPG's family that looks along them and acts by samples",
    "ddpg": "strokes by reward: plain DDPG with hindsight experience replay",
}


def main(arguments: list[str] | None = None) -> int:
    """Runs one command and returns its exit code; wrong arguments raise SystemExit(2)."""
    options = _parser().parse_args(arguments)
    draw_without_a_screen()
    keep_compiled_programs()
    return ended(lambda: options.command(options))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="python -m train", description="Learners that shape sand. Every command answers --help.")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=Parser)
    for learner in MINUTES:
        _training(commands, learner)
    _evaluation(commands)
    _shipping(commands)
    _export(commands)
    return parser


def _training(commands: "argparse._SubParsersAction[Parser]", learner: str) -> None:
    p = commands.add_parser(learner, help=_ABOUT[learner], description=f"Trains {_ABOUT[learner]}.")
    end = p.add_mutually_exclusive_group()
    of_paper = ", or 10,000 episodes with --paper" if learner == "ddpg" else ""
    end.add_argument("--minutes", type=_minutes, metavar="M", help=f"minutes of work ({MINUTES[learner]:g}{of_paper})")
    end.add_argument("--steps", type=count, metavar="N", help=_STEPS[learner])
    p.add_argument("--seed", type=seed, default=0, metavar="K", help="of everything drawn by chance (0)")
    p.add_argument("--out", type=path_name, metavar="RUN", help=f"folder of the run (runs/{learner}-SEED)")
    p.add_argument("--resume", action="store_true", help="go on with the run there; minutes and steps count from its start")
    p.add_argument("--tensorboard", action="store_true", help="write its metrics for TensorBoard as well")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    if learner == "ddpg":
        p.add_argument("--paper", action="store_true", help="the paper's setting: 10,000 episodes (runs/ddpg-paper-SEED)")
    p.set_defaults(command=run_training, learner=learner, paper=False)


def _evaluation(commands: "argparse._SubParsersAction[Parser]") -> None:
    p = commands.add_parser("evaluate", help="how many glyphs, or for dqn letter maps, a run gets right")
    p.add_argument("run", metavar="RUN|pretrained", help="folder of a run, whose best state is used, or what jaxsand ships")
    which = p.add_mutually_exclusive_group()
    which.add_argument("--glyphs", type=path_name, metavar="FILE.json", help="names, each with strokes of the unit square")
    which.add_argument("--goals", metavar="NAME", help="a set of goals (letters); a wrong name lists them")
    p.add_argument("--lookahead", type=width, metavar="K", help="try its K best actions on K plans, with the simulator")
    p.add_argument("--refine", action="store_true", help="improve its plan by gradients through the simulator")
    p.add_argument(
        "--out", type=path_name, metavar="DIR", help="folder for the report, and for a picture of goals and results on sand"
    )
    p.add_argument("--html", action="store_true", help="also write evaluate.html: goals and sand, in a browser")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=run_evaluation)


def _shipping(commands: "argparse._SubParsersAction[Parser]") -> None:
    p = commands.add_parser("ship", help="make the best policy of a hindsight run the one that jaxsand comes with")
    p.add_argument("run", type=path_name, metavar="RUN", help="folder of the run")
    p.add_argument("--out-file", type=path_name, default=SHIPPED, metavar="FILE.npz", help="another place for it")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=run_shipping)


def _export(commands: "argparse._SubParsersAction[Parser]") -> None:
    p = commands.add_parser("export", help="write a policy as a function that JAX runs without jaxsand")
    p.add_argument("run", metavar="RUN|pretrained", help="folder of a hindsight run, or what jaxsand ships")
    p.add_argument("--out", type=path_name, required=True, metavar="FILE", help="where to")
    p.add_argument("--count", type=count, default=1, metavar="K", help="strokes for each map (1)")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=run_export)


def _minutes(text: str) -> float:
    try:
        minutes = float(text)
    except ValueError:
        minutes = math.nan
    if not 0 < minutes < math.inf:
        raise argparse.ArgumentTypeError(f"got {text!r}, which is no number above 0")
    return minutes


if __name__ == "__main__":
    sys.exit(main())
