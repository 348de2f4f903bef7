"""The command ``python -m research``: experiments and benches, and the engine's own commands on lifts of baselines.
What a command runs is imported when it is needed, so that --help and a typing error need no torch."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from engine.command_line.main import Parser
from engine.command_line.main import main as run_command
from engine.command_line.main import make_parser as parser_of_the_engine
from engine.errors import PlgsError
from engine.job import ExitCode
from engine.job.request import add_amount_options, add_options, add_set_option, preset_or_file
from engine.job.terminal import Interrupted, Interrupts
from engine.presets.options import parsed_options, with_options
from engine.presets.preset import PRESETS
from engine.scene_source import UP_OPTIONS

from .baselines.options import with_baseline_options

SAMPLE = "sample/room"
OF_THE_ENGINE = ("lift", "bake", "export", "evaluate", "presets")
"""Commands of the engine that also take the baselines' options here."""


def main(arguments: Sequence[str]) -> int:
    """Run a command and return its exit code. Bad arguments raise SystemExit(2), as with argparse."""
    if arguments[:1] and arguments[0] in OF_THE_ENGINE:
        with_baseline_options()
        return run_command(arguments, _parser_of_the_engine)
    return run_command(arguments, make_parser)


def _parser_of_the_engine() -> argparse.ArgumentParser:
    """Return the engine's parser, whose lifts are run by this program, which knows the baselines."""
    from .baselines.method import lift_baseline  # which registers the baselines' kinds of decoders

    parser = parser_of_the_engine()
    parser.set_defaults(program="research", lift=lift_baseline)
    return parser


def make_parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="python -m research",
        description="Baselines, experiments and benches. The engine's commands "
        f"{', '.join(OF_THE_ENGINE)} are here too, with the baselines' options.",
    )
    known = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_experiments(known.add_parser("experiments", help="lift many scenes and show their figures in one table"))
    _add_bench(known.add_parser("bench", help="measure this machine"))
    unfinished = known.add_parser("unfinished", help="what a lift that is still in training would score now")
    unfinished.add_argument("lift", type=Path, metavar="LIFT", help="the folder of a lift; it may go on meanwhile")
    unfinished.set_defaults(run=run_printing, lines=_unfinished)
    reliability = known.add_parser("reliability", help="how often pixels are right, by their confidence")
    reliability.add_argument("lifts", nargs="+", type=Path, metavar="LIFT", help="finished lifts with ground truth")
    reliability.add_argument("--picture", type=Path, metavar="FILE", help="save the diagram there (needs matplotlib)")
    reliability.set_defaults(run=run_printing, lines=_reliability)
    return parser


def _add_experiments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Lift every scene once for each row of the paper's tables, each in its own process and without passes, and "
        "print the tables in Markdown: baselines, ablations, departures from the paper. Finished lifts in FOLDER are "
        "kept, stopped ones continue."
    )
    about = f"a scene's folder; AXIS is one of {', '.join(UP_OPTIONS)}"
    parser.add_argument("scenes", nargs="*", metavar="SCENE[:up=AXIS]", help=f"{about} (default: {SAMPLE})")
    parser.add_argument("--names", type=_names, metavar="A,B,..", help="scene names (default: their folders' names)")
    parser.add_argument("--only", nargs="+", default=[], metavar="ROW|TABLE", help="only these rows or tables")
    parser.add_argument("--list", action="store_true", help="list the tables and rows")
    parser.add_argument(
        "--preset", type=preset_or_file, default="preview", metavar="NAME|FILE.toml",
        help="as for lift (default: preview)",
    )  # fmt: skip
    add_set_option(parser)
    parser.add_argument(
        "--masks", type=Path, metavar="PATH",
        help="panoptic masks outside SCENE, such as 'predictions/{scene}', in which {scene} is the scene's name",
    )  # fmt: skip
    parser.add_argument(
        "--depth", type=Path, metavar="FOLDER", help="depth maps by a network, as for lift, such as 'depths/{scene}'"
    )
    add_options(parser, "mask_format", "classes", "scene_format", "device")
    add_amount_options(parser)
    parser.add_argument("--seeds", type=_seeds, default=[0], metavar="0,1,..", help="random seeds (default: 0)")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("lifts/experiments"), metavar="FOLDER",
        help="where lifts, results.json, .csv and .md go (default: lifts/experiments)",
    )  # fmt: skip
    parser.add_argument("--finished", action="store_true", help="lift nothing: print tables of the finished lifts")
    parser.set_defaults(run=run_experiments)


def _add_bench(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(required=True, metavar="WHAT")
    step = kinds.add_parser("step", help="time the parts of a training step of a lift of the sample, and drawing it")
    step.add_argument(
        "--preset", choices=PRESETS, help="a lift by this preset (default: standard on enlarged frames, coarsely)"
    )
    step.set_defaults(run=run_bench)
    masks = kinds.add_parser("masks", help="score many pairs of a scene and masks of it, and compare with another run")
    masks.add_argument("pairs", type=Path, metavar="FOLDER", help="holds SCENE/scene, and SCENE/MASKS for each masks")
    masks.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="pairs whose names contain one of these")
    masks.add_argument("--preset", choices=PRESETS, default="preview", help="as for lift (default: preview)")
    masks.add_argument("--sizes", type=_seeds, default=[160, 200], metavar="160,200", help="picture sizes in pixels")
    masks.add_argument("--against", type=Path, metavar="FILE", help="a run to compare with (default: the stored one)")
    masks.set_defaults(run=run_masks)
    for each in (step, masks):
        add_set_option(each)
        each.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to a file")


def run_printing(options: argparse.Namespace) -> int:
    """Run a command that answers with a table, and print its lines. Raises what the command raises."""
    for line in options.lines(options):
        print(line, flush=True)
    return ExitCode.FINISHED


def _unfinished(options: argparse.Namespace) -> Iterator[str]:
    from .unfinished import unfinished_scores

    return unfinished_scores(options.lift)


def _reliability(options: argparse.Namespace) -> Iterator[str]:
    from .reliability import reliability_table

    return reliability_table(options.lifts, options.picture)


def run_experiments(options: argparse.Namespace) -> int:
    """Run the rows, one process each, and print the tables. Raises PlgsError for bad options."""
    from .experiments.experiment import SHARED, Experiment, scenes_from
    from .experiments.rows import read_rows
    from .experiments.run import run_experiment

    with_baseline_options()
    rows = read_rows()
    if options.list:
        print(*rows.listed(), sep="\n")
        return ExitCode.FINISHED
    experiment = Experiment(
        scenes=scenes_from(options.scenes or [SAMPLE], options.names), folder=options.output, rows=rows,
        only=tuple(options.only), sets=tuple(options.set or ()), masks=options.masks, depth=options.depth,
        seeds=tuple(options.seeds), only_finished=options.finished,
        **{name: getattr(options, name) for name in SHARED},
    )  # fmt: skip
    try:
        with Interrupts() as interrupts:
            return run_experiment(experiment, interrupts)
    except Interrupted as error:
        print("Stopped. Give the same command again to continue.", file=sys.stderr)
        return error.exit_code


def run_bench(options: argparse.Namespace) -> ExitCode:
    """Run the bench, print its figures and write them to a file. Raises PlgsError for bad options."""
    from .bench_step import bench_step

    if options.json is not None:
        _refuse_unwritable(options.json)
    if options.set and options.preset is None:
        raise PlgsError("bench-set", "--set needs a preset to change", "--set", "Add --preset NAME.")
    preset = None
    if options.preset is not None:
        preset = with_options(PRESETS[options.preset], parsed_options(options.set or ()))
    figures = bench_step(preset)
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return ExitCode.FINISHED


def run_masks(options: argparse.Namespace) -> ExitCode:
    """Score pairs of scene and masks; print how scores differ from a stored run. Raises PlgsError for bad options."""
    from .bench_masks import STORED, bench_masks, differences, pairs_in, read_run, write_run

    if options.json is not None:
        _refuse_unwritable(options.json)
    preset = with_options(PRESETS[options.preset], parsed_options(options.set or ()))
    before, run = read_run(options.against or STORED), {}
    for run in bench_masks(pairs_in(options.pairs, options.only), preset, options.sizes):
        print(*("{} {:.1f} / {:.1f}".format(key, *run[key]) for key in list(run)[-1:]), file=sys.stderr)
        if options.json is not None:
            write_run(options.json, run)
    print(*differences(run, before), sep="\n")
    return ExitCode.FINISHED


def _refuse_unwritable(file: Path) -> None:
    """Raise PlgsError, before minutes of work, if ``file`` could not be written."""
    if file.is_dir():
        raise PlgsError("folder-not-file", "the figures cannot be written to a folder", file, "Name a file in it.")
    if not file.parent.is_dir():
        what = "the folder for the figures does not exist"
        raise PlgsError("no-folder", what, file.parent, "Create it, or name another file.")
    if not os.access(file if file.exists() else file.parent, os.W_OK):
        what = "the file cannot be written"
        raise PlgsError("unwritable", what, file, "Name a file in a folder that you may write to.")


def _names(text: str) -> list[str]:
    return text.split(",")


def _seeds(text: str) -> list[int]:
    seeds = text.split(",")
    if not all(seed.isdecimal() for seed in seeds):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of whole numbers such as 0,1,2")
    return list(dict.fromkeys(map(int, seeds)))  # each once, in the given order
