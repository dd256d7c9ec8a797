"""The text of a search for causes: the outcome, its causes and remedies, and what was tried."""

from collections.abc import Iterator, Sequence

from echelon.core.digits import about
from echelon.core.words import amount
from echelon.experiments.results.role_outcome import Grade, RoleOutcome, RunOutcome
from echelon.experiments.studies.causes import CauseStudy, Effect, TriedChange

_WHOSE = {"leader": "leader's", "followers": "followers'"}
_SHORT = 60
"""Characters of a key that is printed; a matrix is longer."""


def outcome_sentence(outcome: RunOutcome, unit: str) -> str:
    """Return the outcome of a run in a sentence, each role with its class and its error."""
    roles = (f"{role} {_sized(x, unit)}" for role, x in outcome._asdict().items() if x is not None)
    return f"Outcome: {'; '.join(roles)}."


def _sized(role: RoleOutcome, unit: str) -> str:
    # The number of an agent that is lost says how long it has been lost.
    known = role.error is not None and role.grade is not Grade.LOST
    return f"{role.grade}, error {_number(role, unit)}" if known else str(role.grade)


def _number(role: RoleOutcome | None, unit: str) -> str:
    if role is None or role.error is None or role.grade is Grade.LOST:
        return "lost"
    return f"{about(role.error)} {unit}".rstrip()


def causes_report(study: CauseStudy) -> str:
    """Return what was found, a sentence each."""
    return "\n".join(f"- {sentence}" for sentence in causes_sentences(study))


def causes_sentences(study: CauseStudy) -> Iterator[str]:
    """Yield the outcome, its causes, other helps, remedies, and what was tried or was not."""
    yield outcome_sentence(study.outcome, study.unit)
    if not study.poor:
        yield "Everybody arrived, so there is no cause to look for."
        return
    yield from _placebos(study)
    found = {role: study.causes(role) for role in study.poor}
    named = list(dict.fromkeys(x.words for trials in found.values() for x in trials))
    by_words = {trial.words: trial for trial in study.trials}
    for words in named:
        roles = [role for role, trials in found.items() if by_words[words] in trials]
        yield from _cause(study, by_words[words], roles)
    for trial in study.trials:
        roles = [x for x, effect in trial.effects.items() if effect is Effect.EXPLAINS]
        if roles and trial.words not in named:
            text = f"Helps too: {trial.words}"
            yield f"{text}; {_instead(study, trial, roles)}."
    yield from _none(study, [role for role, trials in found.items() if not trials])
    yield from _remedies(study.trials)
    for trial in study.trials:
        roles = [x for x, effect in trial.effects.items() if effect is Effect.WORSENS]
        if roles:
            yield f"Worse with {trial.words}: {_instead(study, trial, roles)}."
    yield from _rest(study)


def _cause(study: CauseStudy, trial: TriedChange, roles: Sequence[str]) -> Iterator[str]:
    """Yield what a change explains, of the roles that it explains in the same way."""
    kinds: dict[str, list[str]] = {}
    for role in roles:
        after, before = getattr(trial.outcome, role), getattr(study.outcome, role)
        kind = "Would not have happened"
        if after.grade is not Grade.ARRIVED:
            lost = before.grade is Grade.LOST
            kind = f"The {role} would not have been lost" if lost else "Would have been smaller"
        kinds.setdefault(kind, []).append(role)
    for kind, of in kinds.items():
        yield f"{kind} with {trial.words}: {_instead(study, trial, of)}."


def _instead(study: CauseStudy, trial: TriedChange, roles: Sequence[str]) -> str:
    pairs = []
    for role in roles:
        after = _number(getattr(trial.outcome, role), study.unit)
        before = _number(getattr(study.outcome, role), study.unit)
        who = f"{role}" if after == "lost" else f"{_WHOSE[role]} error"
        pairs.append(f"{who} {after} instead of {before}")
    return "; ".join(pairs)


def _none(study: CauseStudy, roles: Sequence[str]) -> Iterator[str]:
    if not roles:
        return
    of = " and ".join(f"the {role}" for role in roles)
    tried = ", ".join(trial.words for trial in study.trials if len(trial.changes) == 1)
    pairs = sum(len(trial.changes) > 1 for trial in study.trials)
    text = f"No single cause found for {of}; tried: {tried or 'nothing'}"
    yield f"{text}; and {amount(pairs, 'pair')} of them." if pairs else f"{text}."


def _remedies(trials: Sequence[TriedChange]) -> Iterator[str]:
    texts = []
    for trial in (trial for trial in trials if trial.remedy):
        keys = " ".join(f"--set {_quoted(key)}" for key in trial.keys)
        texts.append(f"{trial.words} (`{keys}`)" if len(keys) <= _SHORT else trial.words)
    if texts:
        yield f"Remedies, each simulated: {'; '.join(texts)}."


def _quoted(key: str) -> str:
    return f'"{key}"' if set(key) & set(" {[") else key


def _placebos(study: CauseStudy) -> Iterator[str]:
    """Yield how far the reruns are apart, by which a change must be exceeded."""
    count = len(study.placebos)
    if not count:
        return
    texts = []
    for role in study.poor:
        outcomes = [getattr(x, role) for x in study.placebos if getattr(x, role) is not None]
        errors = [x.error for x in outcomes if x.grade is not Grade.LOST and x.error is not None]
        lost = len(outcomes) - len(errors)
        parts = [f"lost in {lost} of {count}"] if lost else []
        if errors:
            low, high = (f"{about(x(errors))}" for x in (min, max))
            span = low if low == high else f"{low} to {high}"
            parts.append(f"error {span} {study.unit}".rstrip())
        texts.append(f"{role} {' or '.join(parts)}")
    yield f"{count} reruns from starts moved by 1e-9 or with other seeds: {'; '.join(texts)}."
    for role in study.poor:
        outcomes = (getattr(x, role) for x in study.placebos)
        arrived = sum(x is not None and x.grade is Grade.ARRIVED for x in outcomes)
        if arrived:
            verb = "arrives" if role == "leader" else "arrive"
            text = f"The {role} {verb} in {arrived} of these reruns"
            yield f"{text}, so the start or the seed decides, and no change counts."


def _rest(study: CauseStudy) -> Iterator[str]:
    without = [
        trial.words
        for trial in study.trials
        if len(trial.changes) == 1 and set(trial.effects.values()) == {Effect.NONE}
    ]
    if without and any(study.causes(role) for role in study.poor):
        yield f"No effect: {', '.join(without)}."
    reasons: dict[str, list[str]] = {}
    for words, reason in study.untried:
        reasons.setdefault(reason, []).append(words)
    for reason, words in reasons.items():
        yield f"Not tried, since {reason}: {', '.join(words)}."
