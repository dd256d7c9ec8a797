"""The closed loop from keywords, for tests that vary one part of a run at a time."""

import echelon as ech


def run(model, graph, formation, drive, **more):
    """Simulate under a drive; settings, starts and world stand among the keywords."""
    world = ech.World(more.pop("plant", None), more.pop("disturbance", None))
    starts = {
        "initial": more.pop("initial", None),
        "start_error": more.pop("start_error", None) or {},
    }
    progress = more.pop("progress", None)
    parts = ech.Parts(model, graph, formation, drive, **starts, world=world)
    return ech.simulate(parts, ech.Settings(**more), progress)


def simulate(model, graph, formation, *, leader, follower, **more):
    """Simulate under laws."""
    return run(model, graph, formation, ech.Laws(leader, follower), **more)


def simulate_plans(model, graph, formation, *, reference=None, planning=None, **more):
    """Simulate plans replayed open loop."""
    options = {} if planning is None else {"options": planning}
    return run(model, graph, formation, ech.optimal.Plans(reference, **options), **more)


def simulate_mpc(model, graph, formation, *, reference=None, mpc=None, **more):
    """Simulate plans over a receding horizon."""
    options = {} if mpc is None else {"mpc": mpc}
    return run(model, graph, formation, ech.optimal.RecedingHorizon(reference, **options), **more)
