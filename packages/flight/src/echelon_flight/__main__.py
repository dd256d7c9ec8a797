"""`python -m echelon_flight FOLDER`: one process of a flight that was prepared in a folder."""

import argparse
import contextlib
import math
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from echelon_flight import FlightError, __version__
from echelon_flight.agent_process import AgentContext, AgentProcess, PlanClock
from echelon_flight.datagram_socket import (
    LOOPBACK,
    PORT,
    Address,
    DatagramSocket,
    ports_of,
    read_address,
    tell_once,
)
from echelon_flight.links import Link, open_link
from echelon_flight.mission import Mission
from echelon_flight.supervisor import Fault
from echelon_flight.wire import GROUND, Report


def main() -> None:
    """Run one process; an error is one sentence and exit code 2."""
    options = _options()
    try:
        code = _run(Mission(options.folder), options)
    except FlightError as error:
        print(f"echelon-flight: {error}", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        code = 130
    raise SystemExit(code)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m echelon_flight", description=__doc__)
    say = parser.add_argument
    say("--version", action="version", version=f"echelon-flight {__version__}")
    say("folder", type=Path, help="a folder that `echelon fly --out` wrote")
    say("--agent", type=int, help="fly this agent")
    say("--agents", help="fly these agents, such as 0,1,2, by one process and one dongle")
    say("--all", action="store_true", help="fly all, with simulated vehicles")
    say("--ground", action="store_true", help="serve the page of the ground station")
    say("--phone", action="store_true", help="let phones on the network see the page, and stop")
    say("--ros2", action="store_true", help="publish poses, goals and markers to ROS 2")
    say("--dry-run", action="store_true", help="check everything, and send nothing to others")
    say("--link", default="udp", help="to the vehicle: udp, cflib://.., px4://.. or ros2://..")
    say("--positions", type=Path, help="a Python file whose class `Positions` yields positions")
    say("--key", type=Path, help="the key file of the formation")
    say("--listen", help="address and port to hear others at")
    say("--to", help="addresses and ports of others, separated by commas")
    say("--interface", default=LOOPBACK, help="own address on the network of a multicast group")
    say("--seconds", type=float, help="length of the flight (default: the scenario's horizon)")
    say("--speed", type=float, default=1.0, help="below 1, simulated vehicles are slower")
    say("--port", type=int, default=PORT, help="of agent 0 on this machine")
    say("--vehicles", action="store_true", help=argparse.SUPPRESS)
    say("--weather", nargs=3, type=float, help=argparse.SUPPRESS)
    return parser.parse_args()


def _run(mission: Mission, options: argparse.Namespace) -> int:
    here = options.link.startswith("udp") or f":{LOOPBACK}:" in options.link.replace("/", ":")
    if not (0.0 < options.speed < 1.0 and here or options.speed == 1.0):
        raise FlightError(
            f"`--speed` is {options.speed:g}, and must be above 0 and at most 1; 1 where "
            "the vehicle is not on this machine."
        )
    if options.seconds is not None and not options.seconds > 0.0:
        raise FlightError(f"`--seconds` is {options.seconds:g}, and must be above 0.")
    # Imported where they are used: an agent's process stays small.
    if options.ros2 and not (options.ground or options.all):
        raise FlightError("`--ros2` is for the ground station: give it with `--ground` or `--all`.")
    if options.phone and not options.ground:
        raise FlightError("`--phone` is for the ground station: give it with `--ground`.")
    if options.vehicles:
        from echelon_flight.simulated_vehicles import Vehicles, simulated

        Vehicles(mission, simulated(mission), options.speed, options.port).run()
    if options.weather:
        from echelon_flight.simulated_vehicles import LinkImpairment, carry

        ports, impairment = ports_of(mission.agents, options.port), LinkImpairment(*options.weather)
        carry(options.port + mission.agents + 1, ports, impairment, options.speed)
    if options.all:
        return _fly_all(mission, options)
    if options.ground:
        return _watch(mission, options)
    if options.agents is not None:
        return _fly_several(mission, options)
    if options.agent is None:
        raise FlightError("give `--agent` with a number, `--agents`, `--all` or `--ground`.")
    return _fly(mission, options)


def _ways(
    mission: Mission, number: int, options: argparse.Namespace
) -> tuple[Address, list[Address]]:
    """Return where a process listens, and where it sends to: on this machine unless told."""
    ports = ports_of(mission.agents, options.port)
    own = ports[min(number, mission.agents)]
    listen = read_address(options.listen, "--listen") if options.listen else own
    if options.to is None:
        return listen, [listen] if options.listen else [port for port in ports if port != own]
    return listen, [read_address(text, "--to") for text in options.to.split(",")]


def _fly(mission: Mission, options: argparse.Namespace) -> int:
    """Fly one agent."""
    context = _context(mission, options, options.agent, options.link)
    _forward(mission, options, [context])
    if options.dry_run:
        _check_state(context, options.link, mission.parameters["state_patience"])
        return 0
    fault = AgentProcess(context, _seconds(mission, options)).run()
    return 0 if fault in (Fault.END, Fault.SIGNAL) else 1


def _fly_several(mission: Mission, options: argparse.Namespace) -> int:
    """Fly several agents by this process."""
    from echelon_flight import one_process

    numbers = one_process.read_numbers(options.agents, mission.agents)
    links = one_process.read_links(options.link, numbers)
    direct = [_context(mission, options, k, link) for k, link in zip(numbers, links, strict=True)]
    contexts = one_process.share(direct)
    _forward(mission, options, direct)
    if links[0].startswith("cflib"):
        carried = mission.parameters["radio_setpoints"]
        if sentence := one_process.warn(mission.facts["dt"], carried, len(numbers)):
            print(f"echelon-flight: {sentence}", file=sys.stderr, flush=True)
    if options.dry_run:
        for context, link in zip(contexts, links, strict=True):
            _check_state(context, link, mission.parameters["state_patience"])
        return 0
    for context in contexts:
        context.socket.skip()
    seconds = _seconds(mission, options)
    faults = one_process.fly_together([AgentProcess(each, seconds) for each in contexts])
    return 0 if {*faults} <= {Fault.END, Fault.SIGNAL} else 1


def _forward(
    mission: Mission, options: argparse.Namespace, contexts: Sequence[AgentContext]
) -> None:
    """Forward positions from the file that `--positions` names."""
    if options.positions is None:
        return
    from echelon_flight.links.crazyflie import CflibLink
    from echelon_flight.positions import PositionForwarder, load_positions

    links = {each.wire.number: each.link for each in contexts}
    known = {k: link for k, link in links.items() if isinstance(link, CflibLink)}
    if len(known) < len(links):
        raise FlightError("`--positions` is for the link `cflib`; other vehicles have their own.")
    source, patience = load_positions(options.positions), mission.parameters["first_position"]
    PositionForwarder(source, known, patience).start()


def _seconds(mission: Mission, options: argparse.Namespace) -> float:
    return mission.facts["horizon"] if options.seconds is None else options.seconds


def _context(
    mission: Mission, options: argparse.Namespace, number: int, address: str
) -> AgentContext:
    """Return what an agent uses, with an open link; tell the ground where that fails."""
    wire = mission.wire(number, options.key)
    listen, to = _ways(mission, number, options)
    try:
        law, facts = mission.law(number)
        socket = DatagramSocket(listen, to, options.interface)
        link = open_link(address, facts | {"parameters": mission.parameters})
    except FlightError as error:
        if not options.dry_run:
            tell_once(wire.note(time.time(), str(error).rstrip(".")), to, options.interface)
        raise
    # The start may have been said often while the link was opened.
    socket.skip()
    rest = socket, wire, PlanClock(options.speed), mission.log(facts, address), address
    return AgentContext(law, facts, mission.facts, link, *rest)


def _check_state(context: AgentContext, address: str, patience: float) -> None:
    """Wait for a state of the vehicle, and say that all is well."""
    _wait_for_state(context.link, address, patience)
    number = context.wire.number
    print(f"agent {number}: all checks passed; nothing was sent to other agents.")


def _wait_for_state(link: Link, address: str, patience: float) -> None:
    """Wait for a state of the vehicle, some seconds at most.

    Raises:
        FlightError: none came.
    """
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        reading = link.read(0.1)
        if reading is not None and all(map(math.isfinite, reading.x)):
            link.close()
            return
    raise FlightError(
        f"no state of the vehicle arrived within {patience:g} s over the link `{address}`; switch "
        "it on, and check `--link`. To check the flight without vehicles, use `--all --dry-run`."
    )


def _watch(mission: Mission, options: argparse.Namespace) -> int:
    """Serve the page of the ground station until Ctrl-C."""
    from echelon_flight.ground import Ground, page_of

    listen, to = _ways(mission, GROUND, options)
    wire = mission.wire(GROUND, options.key)
    socket = DatagramSocket(listen, to, options.interface)
    view = _view(mission, options)
    ground = Ground(socket, wire, mission.agents, view, mission.parameters)
    ground.listen()
    with contextlib.ExitStack() as pages:
        page = page_of(ground)
        where = f"the ground station is at {pages.enter_context(page.serving())}"
        if options.phone:
            phone = pages.enter_context(page.serving_others())
            where += f", and phones see and stop at {phone}"
        print(f"echelon-flight: {where}. Ctrl-C quits.", file=sys.stderr, flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(1.0)
    return 0


def _view(mission: Mission, options: argparse.Namespace) -> Callable[[int, Report], None]:
    """Return who takes reports besides the ground station's page."""
    if not options.ros2:
        return lambda number, report: None
    from echelon_flight.ros2_view import Ros2View

    return Ros2View(mission.facts).report


def _fly_all(mission: Mission, options: argparse.Namespace) -> int:
    """Fly all agents with simulated vehicles, and print their errors."""
    from echelon_flight.ground import page_of
    from echelon_flight.local_flight import LocalFlight

    seconds = mission.facts["horizon"] if options.seconds is None else options.seconds
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    for k in range(mission.agents):
        mission.law(k)
    watch = _view(mission, options)
    flight = LocalFlight(mission, seconds, options.speed, options.port, watch=watch)
    if options.dry_run:
        print("All checks passed; nothing was started.")
        return 0
    with page_of(flight.ground).serving() as address, flight:
        print(f"The ground station is at {address}.")
        for k in range(mission.agents):
            ready, size = flight.ready[k], flight.memory(k)
            print(f"- agent {k}: ready after {ready:.2f} s, {size:.0f} MB", flush=True)
        print(f"All are ready; the plan takes {seconds:g} s.", flush=True)
        while flight.time() < seconds:
            time.sleep(0.05)
        errors, faults = flight.errors(), flight.ground.faults
        if mission.facts["vehicles"]["height"] is not None:
            flight.wait_until_down()
    since = max(0.0, seconds - 4.0)
    for k in set(range(mission.agents)) - {mission.facts["leader"]}:
        worst = 1e3 * errors.worst(k, since)
        print(f"- agent {k}: {worst:.1f} mm from its place at most, in the last 4 s")
    early = [k for k, fault in faults.items() if fault not in (Fault.NONE, Fault.END)]
    if early:
        print(f"{len(early)} agents descended before the end.")
    if errors.late or Fault.STALE in faults.values():
        print("This machine did not keep up with the vehicles; with `--speed 0.2` it may.")
    return int(bool(early))


if __name__ == "__main__":
    main()
