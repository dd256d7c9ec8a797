"""`echelon fly`: the processes of a flight, each by itself; this one only prepares them."""

import contextlib
import os
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli import options
from echelon.apps.cli.terminal import STATUS
from echelon.core.errors import FlightError
from echelon.output.archive.folder import check_empty
from echelon_flight import __version__

CONTAINED = "0.1.0"
"""The version of the package `echelon_flight` that is installed with echelon."""
_SCENARIO = "The name of a bundled scenario, a YAML file, or a folder that `--out` wrote."
_Number = Annotated[int | None, typer.Option(help="Fly this agent.")]
_Numbers = Annotated[
    str | None, typer.Option(help="Fly these agents, such as 0,1,2, by one process and dongle.")
]
_All = Annotated[bool, typer.Option("--all", help="Fly all agents, with simulated vehicles.")]
_Ground = Annotated[bool, typer.Option("--ground", help="Serve the ground station's page.")]
_Phone = Annotated[
    bool, typer.Option("--phone", help="Let phones on the network see the page, and stop.")
]
_Ros = Annotated[
    bool, typer.Option("--ros2", help="Publish poses, goals and markers to ROS 2, from the ground.")
]
_Dry = Annotated[
    bool, typer.Option("--dry-run", help="Check everything, and send nothing to others.")
]
_Link = Annotated[
    str, typer.Option(help="Link to the vehicle: udp, cflib://..., px4://... or ros2://...")
]
_Positions = Annotated[
    Path | None, typer.Option(help="A Python file whose class `Positions` yields positions.")
]
_Key = Annotated[Path | None, typer.Option(help="Key file that all agents and the ground share.")]
_Listen = Annotated[
    str | None, typer.Option(help="Receive from others at ADDRESS:PORT, as of a multicast group.")
]
_Interface = Annotated[
    str | None, typer.Option(help="Own address on the network of a multicast group.")
]
_Seconds = Annotated[
    float | None, typer.Option(help="Length of the flight, s (default: the horizon).")
]
_Speed = Annotated[
    float | None, typer.Option(help="Below 1, simulated vehicles are slower than real ones.")
]
_Out = Annotated[
    Path | None, typer.Option("--out", help="Prepare the flight in this folder, and end.")
]


def fly(
    scenario: Annotated[str, typer.Argument(help=_SCENARIO)],
    agent: _Number = None,
    agents: _Numbers = None,
    every: _All = False,
    ground: _Ground = False,
    dry_run: _Dry = False,
    phone: _Phone = False,
    ros2: _Ros = False,
    link: _Link = "udp",
    key: _Key = None,
    positions: _Positions = None,
    listen: _Listen = None,
    interface: _Interface = None,
    seconds: _Seconds = None,
    speed: _Speed = None,
    set_: options.SetOption = None,
    out: _Out = None,
) -> None:
    """Fly a scenario: a process for each agent, which needs neither JAX nor NumPy."""
    _check_version()
    _check(agent, agents, every, ground, key, link, out)
    folder = Path(scenario)
    if not (folder / "flight.json").is_file():
        folder = _prepare(scenario, set_ or [], out)
    if out is not None:
        print(f"- Written to {folder}; `echelon fly {folder} --all` flies it.")
        return
    given = {
        **{"--agent": agent, "--agents": agents, "--link": link, "--key": key},
        **{
            "--positions": positions,
            "--listen": listen,
            "--interface": interface,
            "--seconds": seconds,
            "--speed": speed,
        },
    }
    words = [str(word) for pair in given.items() if pair[1] is not None for word in pair]
    flags = {"--all": every, "--ground": ground, "--dry-run": dry_run}
    flags |= {"--ros2": ros2, "--phone": phone}
    words += [flag for flag, is_set in flags.items() if is_set]
    STATUS.pause()
    sys.stdout.flush()
    # In place of this process, which holds JAX.
    os.execv(sys.executable, [sys.executable, "-m", "echelon_flight", str(folder), *words])


def _check_version() -> None:
    """Say where a distribution of another version may have replaced what echelon contains."""
    from importlib.metadata import PackageNotFoundError, version

    found = {__version__}
    with contextlib.suppress(PackageNotFoundError):
        found.add(version("echelon-flight"))
    for other in found - {CONTAINED}:
        print(
            f"echelon: `echelon-flight` {other} is installed beside echelon, which contains "
            f"{CONTAINED}; uninstall it, then install echelon again.",
            file=sys.stderr,
        )


def _check(
    agent: int | None,
    agents: str | None,
    every: bool,
    ground: bool,
    key: Path | None,
    link: str,
    out: Path | None,
) -> None:
    """Check what can be, before the laws are written, which takes long."""
    from echelon_flight.mission import check_options

    flies = agent is not None or agents is not None
    if sum((agent is not None, agents is not None, every, ground, out is not None)) != 1:
        raise FlightError(
            "give one of `--agent` with a number, `--agents`, `--all`, `--ground` and `--out`."
        )
    check_options(link, key, signs=flies or ground)


def _prepare(scenario: str, changes: list[str], out: Path | None) -> Path:
    from echelon.experiments.scenario.scenario import SCENARIO_FILE, load_scenario

    loaded = load_scenario(scenario, changes)
    if out is not None:
        check_empty(out)
    STATUS.begin(f"writing the laws of {loaded.name}")
    from echelon.experiments.scenario.build import build, origin_of
    from echelon.experiments.scenario.self_contained import content_of_files
    from echelon.output.archive.flight_folder import flight_files, save_flight
    from echelon.output.archive.flown import PLAN, plan_file

    built, origin = build(loaded), origin_of(loaded)
    files: dict[str, str | bytes] = dict(flight_files(*built, content_of_files(loaded)))
    files |= {PLAN: plan_file(*built, origin), **origin["files"]}
    files[SCENARIO_FILE] = origin["provenance"]["scenario_text"]
    folder = Path(tempfile.mkdtemp(prefix="echelon-fly-")) if out is None else out
    save_flight(files, folder)
    return folder
