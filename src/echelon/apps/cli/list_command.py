"""`echelon list` and `echelon schema`: everything a scenario may name."""

import json

from echelon.apps.cli.options import JsonOption


def list_(as_json: JsonOption = False) -> None:
    """List scenarios, models, references, laws, gain methods, graphs, formations, integrators."""
    from echelon.experiments.scenario import registry
    from echelon.experiments.scenario.scenario import bundled_scenarios

    families = {"scenarios": bundled_scenarios(), **registry.families()}
    if as_json:
        print(json.dumps(families, indent=2))
        return
    width = max(len(name) for entries in families.values() for name in entries)
    for title, entries in families.items():
        print(f"{title}:")
        for name, text in entries.items():
            print(f"  {name:<{width}}  {text}")


def schema() -> None:
    """Print the JSON schema of the scenario file, for editors."""
    from echelon.experiments.scenario.scenario import json_schema

    print(json.dumps(json_schema(), indent=2))
