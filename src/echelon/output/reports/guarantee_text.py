"""A guarantee in words, from its data: the block of a terminal and a report, and its short form."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping

from echelon.core.claim import ClaimKind, Number, Rounding, number_in
from echelon.core.digits import at_most
from echelon.core.statement import Hypothesis
from echelon.core.types import JsonObject
from echelon.core.words import GuaranteeVerdict, Kind, Theorem, Verdict
from echelon.guarantees.promises.promise import Guarantee

WIDTH, UNWRAPPED = 80, 10_000
"""Columns of a terminal, and of a line that is not wrapped."""
_LABEL = 14
_KINDS = {
    Kind.PROOF: "exact proof",
    Kind.VERTICES: "vertices of a hull",
    Kind.SAMPLES: "seen at samples",
    Kind.LINEARIZATION: "linearization",
}
_LABELS = {
    ClaimKind.CONVERGES: "converges",
    ClaimKind.BOUNDED: "V never rises",
    ClaimKind.APART: "never touch",
}
_NOTED = (Hypothesis.CLAIMS, Hypothesis.MESSAGES, Hypothesis.OWN_STATE)
"""Conditions that are told where they fail and leave a guarantee."""
Row = tuple[str, str]
"""A label, empty where it is that of the row above, and a phrase."""


def guarantee_text(stated: "Guarantee | Mapping[str, object]") -> str:
    """Return a guarantee in words, from itself or from its data: lines of at most 80 columns."""
    return "\n".join(guarantee_lines(stated))


def guarantee_lines(
    stated: "Guarantee | Mapping[str, object]", width: int = WIDTH, brief: bool = False
) -> list[str]:
    """Return the lines of `guarantee_text`: its verdict, and under it a row for each phrase.

    `brief` leaves out for which graphs it is and what else is known, and joins phrases.
    """
    data = _data(stated)
    lines, rows = [heading(data)], guarantee_rows(data)
    for label, text in _joined(rows) if brief else rows:
        head = f"  {label:{_LABEL}}"
        lines += textwrap.wrap(
            text,
            width,
            initial_indent=head,
            subsequent_indent=" " * len(head),
            break_long_words=False,
            break_on_hyphens=False,
        )
    return lines


def _data(stated: "Guarantee | Mapping[str, object]") -> JsonObject:
    return stated.as_mapping() if isinstance(stated, Guarantee) else dict(stated)


_BRIEF = (
    *("while", "since", "would help", "until", *_LABELS.values()),
    *("rate", "within 1 cm", "distance", "if", "ignores", "but"),
)
"""Labels that a screen has."""


def _joined(rows: Iterable[Row]) -> Iterator[Row]:
    """Yield one row for each label of a screen."""
    joined, last = dict[str, list[str]](), ""
    for label, text in rows:
        last = label or last
        joined.setdefault(last, []).append(text)
    yield from ((label, "; ".join(joined[label])) for label in joined if label in _BRIEF)


def heading(data: JsonObject) -> str:
    """Return the verdict with the kind of the argument and the theorem."""
    kind = Kind.named(data["kind"])
    source = f"{_KINDS[kind]}, {data['theorem']}" if data["theorem"] else _KINDS[kind]
    verdict = GuaranteeVerdict.named(data["verdict"])
    if verdict is GuaranteeVerdict.NONE:
        return "Not guaranteed"
    word = "Guaranteed" if verdict is GuaranteeVerdict.GUARANTEED else "Conditional"
    return f"{word} ({source})" + ", but for what it ignores" * bool(data["ignores"])


def guarantee_rows(data: JsonObject) -> Iterator[Row]:
    """Yield the rows under the heading."""
    if data["claim"] is None:
        yield from _against(data)
    else:
        yield from _claimed(data)
    yield from _labelled("but", _failing(data))
    yield from _labelled("note", data["notes"])
    until = data.get("until")
    if until is not None:
        head = heading(until["guarantee"])
        yield "until", f"{at_most(until['at'], 6)} s: {head[0].lower()}{head[1:]}"
        yield from (row for row in guarantee_rows(until["guarantee"]))


def _labelled(label: str, texts: Iterable[str]) -> Iterator[Row]:
    for text in texts:
        yield label, text
        label = ""


def _against(data: JsonObject) -> Iterator[Row]:
    """What stands against any claim, and what would help."""
    failed = [line for line in data["conditions"] if _fails(line) and line["reason"]]
    yield from _labelled("since", dict.fromkeys(line["reason"] for line in failed))
    yield from _labelled("would help", dict.fromkeys(line["remedy"] for line in failed))


def _fails(line: JsonObject) -> bool:
    return line["verdict"] == str(Verdict.FAILS)


def _claimed(data: JsonObject) -> Iterator[Row]:
    left = [line for line in data["conditions"] if _fails(line) and line["while"]]
    yield from _labelled("while", dict.fromkeys(line["while"] for line in left))
    yield from _labelled("not known", (_unknown(line) for line in left))
    what = ClaimKind.named(data["claim"])
    yield from _labelled(_LABELS[what], _first("from", data["start"]))
    yield from _numbers(data)
    yield from _labelled("for", data["graphs"])
    yield from _labelled("if", data["premises"])
    yield from _labelled("ignores", data["ignores"])


def _first(word: str, texts: Iterable[str]) -> Iterator[str]:
    for text in texts:
        yield f"{word} {text}" if word else text
        word = ""


def _unknown(line: JsonObject) -> str:
    shown = f" ({line['shown']})" if line["shown"] and line["shown"] not in line["text"] else ""
    return f"{line['text']}{shown}"


# ---- numbers -------------------------------------------------------------------------------------


def shown(data: JsonObject, name: str, digits: int = 3) -> str:
    """Return a number with its unit, rounded so that no more is stated than is known."""
    number = data["numbers"][name]
    value = float("inf") if number["value"] is None else number["value"]
    return Number(value, number["unit"], Rounding.named(number["rounding"])).shown(digits)


def _numbers(data: JsonObject) -> Iterator[Row]:
    numbers = data["numbers"]
    yield from _rates(data)
    lost = int(number_in(data, "lost_in_a_row") or 0)
    seldom = ", in all but one run in a million" if lost else ""
    if "within_1_cm" in numbers:
        yield "within 1 cm", f"after {shown(data, 'within_1_cm')} from these starts{seldom}"
    if "kept_distance" in numbers:
        yield "distance", f"{shown(data, 'kept_distance')} are kept between centres, scaled"
    if "first_packet" in numbers:
        yield "messages", f"everybody has a packet after {shown(data, 'first_packet')}{seldom}"
        if lost:
            yield "", f"no link loses more than {lost} in a row{seldom}"
        if "delay" in numbers:
            yield "", f"late ones cost a delay of {shown(data, 'delay')} at most"
    if "motor_least" in numbers:
        text = f"{shown(data, 'motor_least')} to {shown(data, 'motor_largest', 4)}, of "
        text += f"{shown(data, 'motor_limit', 4)}; tilt {shown(data, 'tilt')} at most"
        yield "motors", text


def _rates(data: JsonObject) -> Iterator[Row]:
    numbers, rate, slow = data["numbers"], number_in(data, "rate"), number_in(data, "slowest_mode")
    everywhere = data["theorem"] in (str(Theorem.T5), str(Theorem.T9))
    if rate:
        how = "eventually" if not data["theorem"] else "or faster"
        how += ", from there on" * ("set_entered" in numbers)
        yield "rate", f"{shown(data, 'rate')} {'eventually, on this graph' if everywhere else how}"
        if "message_age" in numbers:
            age = f"no message in use is older than {shown(data, 'message_age')}"
            quick = "quick_rate" in numbers
            yield "", f"{shown(data, 'quick_rate')} while {age}" if quick else age
    if "rate_alone" in numbers:
        yield "rate", f"{shown(data, 'rate_alone')} eventually, where nobody is held back"
    if number_in(data, "coupling") is not None and not data["theorem"] and slow is not None:
        above = ""
        if "edge" in numbers:
            above = f"; any above {shown(data, 'edge', 4)} suffices in continuous time"
        mode = "" if rate and abs(rate + slow) <= 1e-6 * rate else _mode(slow)
        yield "coupling", f"{shown(data, 'coupling', 4)}{above}{mode}"


def _mode(slow: float) -> str:
    return f"; the slowest mode alone decays at {at_most(-slow)} 1/s" if slow < 0.0 else ""


def _failing(data: JsonObject) -> Iterator[str]:
    names = {name.value for name in _NOTED}
    for line in data["conditions"]:
        if line["name"] in names and _fails(line) and not line["reason"] and not line["while"]:
            yield line["text"]
            yield line["remedy"]


# ---- short forms ---------------------------------------------------------------------------------


def short_form(data: JsonObject) -> str:
    """Return a guarantee in a few words, as a badge has it."""
    verdict = GuaranteeVerdict.named(data["verdict"])
    if verdict is GuaranteeVerdict.NONE:
        return "no guarantee"
    left = [line["while"] for line in data["conditions"] if _fails(line) and line["while"]]
    if verdict is GuaranteeVerdict.CONDITIONAL:
        return f"no guarantee: {data['theorem'] or data['kind']} holds while {left[0]}"
    if data["claim"] == str(ClaimKind.APART):
        return f"guaranteed: agents stay apart, {data['theorem']}"
    bounded = data["claim"] == str(ClaimKind.BOUNDED)
    rate = "V does not rise" if bounded else shown(data, "rate")
    return f"guaranteed: {rate}, {data['theorem'] or data['kind']}"


def through_event(data: JsonObject) -> str:
    """Return what is guaranteed through an event, in a sentence."""
    if data["against"]:
        return f"Nothing is guaranteed through it: {data['against']}."
    verdict = GuaranteeVerdict.named(data["verdict"])
    whom = "it" if data["of"] == "all" else "all others through it"
    ignored = f"ignores that {' and '.join(data['ignores'])}"
    if verdict is GuaranteeVerdict.GUARANTEED:
        return f"The guarantee covers {whom}."
    if data["conditions"]:
        text = f"Not guaranteed: the claim covers {whom} while {' and '.join(data['conditions'])}"
        return f"{text}. It {ignored}." if data["ignores"] else f"{text}."
    if data["ignores"]:
        return f"The guarantee would cover {whom}, but {ignored}."
    return "Nothing is guaranteed."
