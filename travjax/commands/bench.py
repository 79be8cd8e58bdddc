"""`travjax bench`: how fast terrain, labelling, the network, site maps and plans are on this machine."""

import argparse

from travjax import options
from travjax.config import require
from travjax.files import user_path


def add(commands: options.Commands) -> None:
    """Adds the command's parser."""
    parser = commands.add_parser(
        "bench",
        help="measure speed",
        description="Measures terrain and labelling on this machine; or the network, the map of a site, or plans.",
    )
    options.add_robot(parser)
    options.add_grid(parser)
    parser.add_argument(
        "--repeats", type=int, default=15, metavar="N", help="timed calls of which the median is taken (15)"
    )
    parser.add_argument(
        "--stream", type=int, default=0, metavar="N", help="also make and label N maps (the paper has 56840)"
    )
    parser.add_argument(
        "--network", action="store_true", help="measure the network instead: inputs, a training step, a whole map"
    )
    parser.add_argument("--site", type=user_path, metavar="SITE", help="measure the map of a site instead")
    parser.add_argument("--plan", action="store_true", help="measure plans on synthetic sites of 60 and 250 m instead")
    options.add_out(parser, "runs/bench")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Measures terrain and labelling, the network, the map of a site, or plans."""
    if arguments.site:
        from travjax.site import site_benchmark

        site_benchmark.measure(arguments.site, arguments.robot, arguments.out)
        return
    if arguments.plan:
        from travjax.plan_results import plan_benchmark

        plan_benchmark.measure(arguments.robot, arguments.out)
        return
    setup = options.setup(arguments)
    require(arguments.repeats > 0, "--repeats", arguments.repeats, "at least 1")
    if arguments.network:
        from travjax.training import network_benchmark

        network_benchmark.measure(setup, arguments.out, arguments.repeats)
    else:
        from travjax.evaluation import simulator_benchmark

        require(arguments.stream >= 0, "--stream", arguments.stream, "at least 0")
        simulator_benchmark.measure(setup, arguments.out, arguments.repeats, arguments.stream)
