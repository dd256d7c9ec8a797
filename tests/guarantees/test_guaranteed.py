"""What the disk cache stores of a guarantee is stored for these parts alone."""

import echelon as ech
from echelon.core.identity import digest
from echelon.guarantees.promises import promise as module

CARTS = ech.models.DoubleIntegrator()
CIRCLE = ech.references.Circle(rate=0.5)


def parts_of(edges=((0, 1), (1, 2)), offset=1.0, model=CARTS, initial=None, **more):
    graph = ech.Graph(edges)
    places = ech.Formation.from_offsets(model, graph, {1: (offset, 0.0), 2: (2.0, 0.0)})
    drive = ech.Laws(ech.laws.StoppingLeader(reference=CIRCLE), ech.laws.StoppingPoint())
    return ech.Parts(model, graph, places, drive, initial, **more)


def key_of(monkeypatch, parts, settings):
    """What a guarantee is stored under."""
    stored = []
    monkeypatch.setattr(module, "load_or_compute", lambda _, *values: stored.append(values) or "")
    module.guaranteed(parts, settings)
    return digest(stored[0])


def test_each_part_counts(monkeypatch):
    settings = ech.Settings(horizon=1.0, dt=0.01)
    cut = ech.network.Cut((1, 2), 0.5, 0.2)
    cases = [
        (parts_of(), settings),
        (parts_of(), settings._replace(dt=0.02)),
        (parts_of(edges=((0, 1), (1, 2, 2.0))), settings),
        (parts_of(edges=((0, 1), (0, 2))), settings),
        (parts_of(offset=1.5), settings),
        (parts_of(initial={"position": 0.5}), settings),
        (parts_of(events=[cut]), settings),
        (parts_of(leadership=ech.Leadership((1,))), settings),
        (parts_of(world=ech.World(network=ech.Network(rate=25.0))), settings),
    ]
    keys = [key_of(monkeypatch, *case) for case in cases]
    assert None not in keys and len({*keys}) == len(cases)
    assert key_of(monkeypatch, parts_of(), settings) == keys[0]


def test_nothing_is_stored_of_a_users_model(monkeypatch):
    class Own(ech.models.DoubleIntegrator):
        pass

    assert key_of(monkeypatch, parts_of(model=Own()), ech.Settings(horizon=1.0, dt=0.01)) is None
