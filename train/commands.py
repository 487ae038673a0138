"""The commands of `train`."""

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jaxsand
from jaxsand.bench.tables import as_table
from jaxsand.cli.files import existing, folder, progress, write_json
from jaxsand.cli.printing import lines, show
from jaxsand.goals.writing import written
from jaxsand.scene.progress import Tell

if TYPE_CHECKING:
    from jaxsand.planning.learned.beam_search import Proposes
    from jaxsand.planning.learned.policy import Policy
    from train.dqn.learner import Dqn, Walking
    from train.runs.runs import Learner

MINUTES = {"hindsight": 30.0, "dqn": 10.0, "actor-critic": 30.0, "ddpg": 10.0}
"""How many minutes each learner trains by default."""

EPISODES = 10_000
"""The number of training episodes in the paper's setting."""

SHIPPED = Path(jaxsand.__file__).parent / "data" / "policy.npz"
"""The file of the policy that comes with jaxsand."""

_REPORT = "evaluate.json"
_POLISH = 4_000  # calls of the simulator for --refine


class Stopped(KeyboardInterrupt):
    """A run was asked to stop, and has stopped."""


def run_training(options: argparse.Namespace) -> None:
    """Trains one learner, and reports where the run is and the best score."""
    if options.tensorboard:
        _tensorboard_writer()
    tell = progress()
    tell(f"{options.learner}: getting ready")
    learner, steps = _learner(options)
    minutes, steps = options.minutes, options.steps or steps
    if minutes is None and steps is None:
        minutes = MINUTES[options.learner]
    name = "ddpg-paper" if options.paper else options.learner
    out = options.out or Path("runs") / f"{name}-{options.seed}"
    from train.runs.runs import run

    with _watch(out, options.tensorboard) as watch:
        ran = run(learner, out, options.seed, minutes=minutes, steps=steps, resume=options.resume, tell=tell, watch=watch)
    tell("")
    if not ran.did:
        print(f"the run in {out} was at its end already; give more --minutes or --steps to go on", file=sys.stderr)
    report = {"run": str(out), "chunks": ran.chunk, "minutes": round(ran.seconds / 60, 3), "best_score": ran.score}
    show(options, report, lines)
    if ran.stopped:
        raise Stopped(f"stopped; go on with --resume --out {out}")


def run_evaluation(options: argparse.Namespace) -> None:
    """Reports how many glyphs, or letter maps, a run's best state gets right."""
    tell = progress()
    tell("getting ready")
    if options.html and not options.out:
        raise ValueError("html: goes to a folder; add --out DIR")
    out = folder(options.out) if options.out else None
    if options.run == "pretrained":
        from jaxsand.planning.learned.policy import load_policy

        report = _on_sand(load_policy(), options, tell, out)
    else:
        from train.runs.runs import learner_of, load

        learner: Any = learner_of(Path(options.run))
        state = load(Path(options.run), learner)
        if learner.name == "dqn":
            report = _on_maps(learner, state, options, tell, out)
        else:
            report = _on_sand(learner.policy(state), options, tell, out)
    tell("")
    show(options, report, _evaluated)


def run_shipping(options: argparse.Namespace) -> None:
    """Writes a run's best policy into the package, with notes on how it was made."""
    from jaxsand.planning.learned.policy import save_policy
    from train.runs.runs import about_run, seed_of

    policy = _policy_of(options.run, "jaxsand ships what hindsight learned")
    at, seed = about_run(options.run), seed_of(options.run)
    about: dict[str, float | str] = {
        "command": f"python -m train hindsight --seed {seed} --steps {at.chunk}",
        "seed": seed,
        "chunks": at.chunk,
        "minutes": round(at.seconds / 60, 2),
        "score": round(at.score, 4),
    }
    with written(options.out_file) as path:
        save_policy(policy, path, **about)
    show(options, {"file": str(options.out_file), "bytes": options.out_file.stat().st_size, **about}, lines)


def run_export(options: argparse.Namespace) -> None:
    """Writes a policy as a function that JAX runs without jaxsand."""
    if options.run == "pretrained":
        from jaxsand.planning.learned.policy import load_policy

        policy = load_policy()
    else:
        policy = _policy_of(Path(options.run), "what hindsight learned is exported, or 'pretrained'")
    policy.export(options.out, options.count)
    show(options, {"file": str(options.out), "bytes": options.out.stat().st_size, "strokes": options.count}, lines)


def _policy_of(run: Path, remedy: str) -> "Policy":
    """The best policy of a hindsight run."""
    from train.imitation.hindsight import Hindsight
    from train.runs.runs import learner_of, load

    learner = learner_of(run)
    if not isinstance(learner, Hindsight):
        raise ValueError(f"run: got one of {learner.name}; {remedy}")
    return learner.policy(load(run, learner))


def _learner(options: argparse.Namespace) -> tuple["Learner", int | None]:
    """The learner, and the number of chunks after which it ends by itself, if any.

    Raises:
      ValueError: if a package that it needs is missing.
    """
    try:
        return _made(options)
    except ModuleNotFoundError as error:
        raise ValueError(f"{options.learner}: {error.name} is not there; run pip install 'jaxsand[train]'") from None


def _made(options: argparse.Namespace) -> tuple["Learner", int | None]:
    """The learner, and the number of chunks after which it ends by itself, if any."""
    if options.learner == "hindsight":
        from train.imitation.hindsight import Hindsight

        return Hindsight(), None
    if options.learner == "dqn":
        from train.dqn.learner import Dqn

        return Dqn(), None
    if options.learner == "actor-critic":
        from train.actor_critic.learner import ActorCritic

        return ActorCritic(), None
    from train.ddpg.learner import Ddpg

    paper = Ddpg.paper()
    return (paper, None if options.minutes else paper.chunks(EPISODES)) if options.paper else (Ddpg(), None)


def _on_sand(policy: "Proposes", options: argparse.Namespace, tell: Tell, out: Path | None) -> dict[str, Any]:
    """Evaluates a policy on glyphs, and writes report and picture if asked."""
    from jaxsand.planning.learned.stages import Stages
    from train.evaluation.glyphs import SETS, read_glyphs
    from train.evaluation.scores import evaluate, page, picture, replayed

    if options.goals is not None and options.goals not in SETS:
        raise ValueError(f"goals: got {options.goals!r}; give one of {', '.join(SETS)}")
    glyphs = read_glyphs(existing(options.glyphs)) if options.glyphs else SETS[options.goals or "letters"]()
    stages = Stages(options.lookahead or 0, _POLISH if options.refine else 0)
    report = evaluate(policy, glyphs, stages, tell)
    if out:
        from jaxsand.viz.render import save_figure

        write_json(out / _REPORT, report)
        maps = replayed(glyphs, report)
        with written(out / "evaluate.png") as path:
            save_figure(lambda: picture(glyphs, report, maps), path)
        if options.html:
            page(glyphs, report, maps).to_html(out / "evaluate.html")
    return report


def _on_maps(learner: "Dqn", state: "Walking", options: argparse.Namespace, tell: Tell, out: Path | None) -> dict[str, Any]:
    """Evaluates a DQN on letter maps, and writes the report if asked."""
    for option in ("glyphs", "goals", "refine", "html"):
        if getattr(options, option):
            raise ValueError(f"{option}: has an effect on strokes only, and dqn walks over maps; leave it out")
    from train.dqn.walks import evaluate

    report: dict[str, Any] = evaluate(learner, state, width=options.lookahead or 0, tell=tell)
    if out:
        write_json(out / _REPORT, report)
    return report


def _evaluated(report: dict[str, Any]) -> str:
    """The report as a table with a row for every glyph or map, and the sums."""
    kind = "glyphs" if "glyphs" in report else "maps"
    rows = [{"name": name, **row} for name, row in report[kind].items()]
    table = as_table([{k: v for k, v in row.items() if k != "pushes"} for row in rows], kind)
    return "\n".join([*table, "", lines({k: v for k, v in report.items() if k != kind})])


@contextmanager
def _watch(out: Path, wanted: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A function that is called with every row of a run's metrics: it writes them for TensorBoard if wanted, else does
    nothing.
    """
    if not wanted:
        yield lambda _: None
        return
    writers: list[Any] = []

    def watch(row: dict[str, Any]) -> None:
        if not writers:  # what was written after the checkpoint that a run goes on from is void
            writers.append(_tensorboard_writer()(str(out / "tensorboard"), purge_step=row["chunk"]))
        for name, value in row.items():
            if name not in ("kind", "chunk"):
                writers[0].add_scalar(f"{row['kind']}/{name}", value, row["chunk"])

    try:
        yield watch
    finally:
        for writer in writers:
            writer.close()


def _tensorboard_writer() -> Any:
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise ValueError("tensorboard: tensorboardX is not installed; pip install tensorboardX, or leave it out") from None
    return SummaryWriter
