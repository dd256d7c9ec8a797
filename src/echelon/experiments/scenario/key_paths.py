"""All keys of a scenario file by their paths, and what a key that does not exist may mean."""

from collections.abc import Iterable, Iterator
from typing import get_args

from pydantic import BaseModel

from echelon.core.errors import did_you_mean

_COMMON_NAMES = {
    "network": "radio wifi communication channel messages packets",
    "network.delay": "delay latency lag",
    "network.loss": "loss_rate packet_loss dropout drop dropped",
    "disturbance": "wind gusts noise turbulence",
    "sensing.noise": "measurement_noise sensor_noise",
    "sensing": "sensors measurement estimation",
    "actuator": "actuators motors motor",
    "actuator.lag": "motor_lag time_constant",
    "plant": "mismatch uncertainty truth",
    "simulation.horizon": "duration time end t_end final_time",
    "simulation.dt": "step timestep time_step",
    "initial": "start starts initial_states x0",
    "graph": "topology",
    "graph.edges": "links",
    "formation.name": "shape",
    "reference": "path trajectory waypoints",
    "follower.law": "controller control law",
    "follower.gain": "gains gain_method",
}
"""Keys by the names that others use for them."""


def sections_in(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield the sections in the annotation of a key: its own, or those of its list."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from sections_in(inner)


def key_paths(section: type[BaseModel], before: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield the path of every key of a section, such as `network.delay`, its description and unit.

    Changes of a live page are left out: no other command takes them; so are the keys of the shape
    of a reshape, which are those of `formation`.
    """
    for key, field in section.model_fields.items():
        inner = next(sections_in(field.annotation), None)
        text = field.description or (inner.__doc__ if inner is not None else "") or ""
        extra = field.json_schema_extra
        unit = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
        key = field.alias or key
        yield before + key, " ".join(text.split()), unit
        if inner is not None and before + key not in ("live", "formation.motion.reshape"):
            yield from key_paths(inner, f"{before}{key}.")


def places_of(wrong: tuple[str | int, ...], scenario: type[BaseModel]) -> list[str]:
    """Return the paths of the keys that an unknown one may mean, the likeliest first.

    Where a key that takes a value has that name, sections of the same name are left out.
    """
    key, section = wrong[-1], [str(part) for part in wrong[:-1] if isinstance(part, str)]
    around = {".".join(section[: k + 1]) for k in range(len(section))}
    paths = [path for path, _, _ in key_paths(scenario)]
    common = [path for path, names in _COMMON_NAMES.items() if str(key) in names.split()]
    same = [path for path in paths if key in (path, path.rpartition(".")[2])]
    places = dict.fromkeys([*common, *sorted(same, key=lambda path: path.count("."))])
    keyed = sections_among(places, scenario)
    valued = {path.rpartition(".")[2] for path in places if path not in keyed}
    return [
        path
        for path in places
        if path not in around and not (path in keyed and path.rpartition(".")[2] in valued)
    ]


def sections_among(places: Iterable[str], scenario: type[BaseModel]) -> set[str]:
    """Return which of these keys have keys of their own."""
    return {*places} & {path.rpartition(".")[0] for path, _, _ in key_paths(scenario)}


def meant(wrong: tuple[str | int, ...], allowed: list[str], scenario: type[BaseModel]) -> str:
    """Return ` (did you mean ...?)` for an unknown key; empty if nothing is close."""
    before, colon, value = str(wrong[-1]).partition(":")
    if colon and value and before in allowed:
        return f" (did you mean `{before}: {value}`, with a space?)"
    places = places_of(wrong, scenario)
    # A slip such as `leader` for `leaders` is likelier than a key of another section.
    here = did_you_mean(wrong[-1], allowed, likeness=0.85 if places else 0.6)
    if here or not places:
        return here
    first, *others = (f"`{path}`" for path in places[:3])
    return f" (did you mean {' or '.join([', '.join([first, *others[:-1]]), *others[-1:]])}?)"
