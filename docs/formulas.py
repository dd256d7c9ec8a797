"""Typeset the formulas of pages: code that is mathematics becomes TeX, which KaTeX draws.

Sources keep plain text, such as `xdot = f(x) + g(x) u`, which reads everywhere. An extension of
Python-Markdown, named in mkdocs.yml. It changes pages with the comment `<!-- formulas -->` alone:
formulas, theorems in frames, lists of tests folded away.
"""

import re
import xml.etree.ElementTree as etree
from typing import Any

from markdown import Markdown
from markdown.extensions import Extension
from markdown.treeprocessors import Treeprocessor
from markdown.util import AtomicString

MARK = "formulas"
_GREEK = dict(
    zip(
        "αβγδεζηθκλμνξπρστφχψωΓΔΘΛΞΠΣΦΨΩ",
        "alpha beta gamma delta varepsilon zeta eta theta kappa lambda mu nu xi pi rho sigma tau "
        "varphi chi psi omega Gamma Delta Theta Lambda Xi prod sum Phi Psi Omega".split(),
        strict=True,
    )
)
_SIGNS = {
    "->": r"\to ",
    "<=": r"\le ",
    ">=": r"\ge ",
    "..": r"\ldots ",
    "||": r"\|",
    "‖": r"\|",
    "⊗": r"\otimes ",
    "×": r"\times ",
    "±": r"\pm ",
    "∫": r"\int ",
    "·": r"\cdot ",
    "∎": r"\blacksquare ",
    "°": r"^\circ ",
    "%": r"\%",
    "*": r"\cdot ",
}
_PLAIN = "+-=<>()[]|,;:./!"
_FUNCTIONS = {
    "sin",
    "cos",
    "tan",
    "exp",
    "log",
    "ln",
    "max",
    "min",
    "det",
    "diag",
    "rank",
    "arsinh",
}
_FUNCTIONS |= {"arg", "Re", "Im", "sign"}
_WORDS = {"roll", "pitch", "yaw", "edge", "hover", "noise", "wind", "mean", "edges", "followers"}
_WORDS |= {"free", "model", "reach"}
_ASCII = {"lambda": r"\lambda ", "rho": r"\rho ", "alpha": r"\alpha "}
_DIFFERENTIALS = {"dx", "dt", "df", "dg", "dz", "dm", "dy", "ds"}
_WORD = re.compile(r"[A-Za-z]{2,}")
_NUMBER = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?(?:e-?\d+)?")
_HALF = re.compile(r"(\d+)/(\d+)(?![\w.(])")
_INDEX = re.compile(r"_(\{[^}]*\}|[A-Za-z0-9]+|[α-ωΑ-Ω]+)")
_SYMBOL = re.compile(
    r"(?<![\w./'-])(?:[A-Za-zα-ωΑ-Ω][~^]?_(?:[a-z0-9]{1,2}|min|max|FL|[α-ω])'*"
    r"|[α-ωΓΔΘΛΞΦΨΩ][~^]?'*|[A-Z]\^-1|[xu]\*)(?!\w)"
)
"""A letter with an index, or a Greek one, in the text."""
_POWER = re.compile(r"-?(?:\d+(?:/\d+)?|[A-Za-zα-ω])")


_THEOREM = re.compile(r"[TA]\d")


class NotMath(ValueError):
    """A text is code or prose, and no formula."""


def tex(text: str, words: bool = False) -> str:
    """Return a formula as TeX.

    Args:
        text: as it stands in the source.
        words: whether unknown words are text in the formula.

    Raises:
        NotMath: the text contains what is no mathematics.
    """
    if text in _FUNCTIONS | _WORDS or _THEOREM.fullmatch(text):
        raise NotMath(text)
    return _Scanner(text, words).all()


class _Scanner:
    """Reads a formula from left to right."""

    def __init__(self, text: str, words: bool) -> None:
        self.text, self.words, self.at = text, words, 0

    def all(self) -> str:
        """Return the whole formula as TeX."""
        parts = list[str]()
        while self.at < len(self.text):
            parts.append(self.next())
        return "".join(parts).strip()

    def next(self) -> str:
        """Return the next part, and move behind it."""
        rest = self.text[self.at :]
        if space := re.match(r"\s+", rest):
            self.at += space.end()
            return r"\quad " if space[0].startswith("  ") else " "
        before = self.text[self.at - 1 : self.at]
        half = _HALF.match(rest)
        if half and not re.match(r"[\w/^.)]", before):
            self.at += half.end()
            return rf"\tfrac{{{half[1]}}}{{{half[2]}}}"
        if number := _NUMBER.match(rest):
            self.at += number.end()
            return self.after(_number(number[0]))
        if root := re.match(r"√(\d+|.)", rest):
            self.at += root.end()
            return rf"\sqrt{{{tex(root[1])}}}"
        if rest.startswith("sqrt("):
            self.at += 4
            return rf"\sqrt{{{self.inside()}}}"
        if word := _WORD.match(rest):
            return self.word(word[0])
        if rest[0].isascii() and rest[0].isalpha():
            self.at += 1
            index = re.match(r"\d+", self.text[self.at :])
            self.at += index.end() if index else 0
            return self.after(rest[0], index[0] if index else "")
        if rest[0] in _GREEK:
            self.at += 1
            return self.dotted(rf"\{_GREEK[rest[0]]} ")
        return self.sign(rest)

    def dotted(self, base: str) -> str:
        """Return a letter with the dots of a derivative after it."""
        for suffix, accent in (("ddot", r"\ddot"), ("dot", r"\dot")):
            if self.text.startswith(suffix, self.at):
                self.at += len(suffix)
                return self.after(f"{accent}{{{base}}}")
        return self.after(base)

    def sign(self, rest: str) -> str:
        """Return an operator or a bracket."""
        for plain, sign in _SIGNS.items():
            if rest.startswith(plain):
                self.at += len(plain)
                return self.after(sign) if plain in ("||", "‖", "∫") else sign
        if rest[0] not in _PLAIN:
            raise NotMath(self.text)
        self.at += 1
        return self.after(rest[0]) if rest[0] in ")|]" else rest[0]

    def word(self, word: str) -> str:
        """Return a run of Latin letters."""
        dotted = re.fullmatch(r"([a-zA-Z])(d?dot)", word)
        self.at += len(word)
        if dotted:
            return self.after(rf"\{dotted[2]}{{{dotted[1]}}}")
        if word in _ASCII:
            return self.after(_ASCII[word])
        if word in _FUNCTIONS:
            return self.after(rf"\operatorname{{{word}}}")
        if word in _DIFFERENTIALS:
            return self.after(rf"\mathrm{{d}}{word[1]}")
        if len(word) == 2 and word.isupper():
            return self.after(word)
        if re.fullmatch(r"I[xyz]{2}", word):
            return self.after("I", word[1:])
        if word not in _WORDS and not self.words:
            raise NotMath(self.text)
        # TeX drops spaces between symbols; a word before this one ends in its own.
        before, after = self.text[: self.at - len(word)], self.text[self.at : self.at + 1]
        first = " " if before.endswith(" ") and not re.search(r"[A-Za-z]{2},? $", before) else ""
        return self.after(rf"\text{{{first}{word}{' ' if after == ' ' else ''}}}")

    def after(self, base: str, index: str = "") -> str:
        """Return a symbol with its accents, index, primes and power."""
        power = ""
        while self.at < len(self.text):
            rest = self.text[self.at :]
            if rest[0] == "~":
                base, step = rf"\tilde{{{base}}}", 1
            elif rest[0] == "'":
                power, step = power + r"\prime ", 1
            elif rest[0] in "²³":
                power, step = power + {"²": "2", "³": "3"}[rest[0]], 1
            elif rest[0] == "*" and re.match(r"\*(?=[^\w(]|$|\()", rest):
                power, step = power + "*", 1
            elif rest.startswith("_("):
                self.at += 1
                index, step = index + self.inside(), 0
            elif found := _INDEX.match(rest):
                index, step = index + _index(found[1]), found.end()
            elif rest[0] == "^" and re.match(r"\^(?=['\s),|]|$)", rest):
                base, step = rf"\hat{{{base}}}", 1
            elif rest[0] == "^":
                self.at += 1
                power, step = power + self.power(base), 0
            else:
                break
            self.at += step
        return base + (f"_{{{index}}}" if index else "") + (f"^{{{power}}}" if power else "") + " "

    def power(self, base: str) -> str:
        """Return what stands behind a caret."""
        rest = self.text[self.at :]
        if rest.startswith("("):
            inner = self.inside()
            # A derivative of an order keeps its brackets; the exponent of e has none.
            return inner if base == "e" else f"({inner})"
        found = _POWER.match(rest)
        if found is None:
            raise NotMath(self.text)
        self.at += found.end()
        return tex(found[0]) if not found[0].startswith("-") else f"-{tex(found[0][1:])}"

    def inside(self) -> str:
        """Return what the brackets that begin here contain, and move behind them."""
        depth, begin = 0, self.at
        for place in range(begin, len(self.text)):
            depth += {"(": 1, ")": -1}.get(self.text[place], 0)
            if depth == 0:
                self.at = place + 1
                return tex(self.text[begin + 1 : place], self.words)
        raise NotMath(self.text)


def _number(text: str) -> str:
    mantissa, _, exponent = text.replace(",", "{,}").partition("e")
    if not exponent:
        return mantissa
    return (r"" if mantissa == "1" else rf"{mantissa} \cdot ") + rf"10^{{{exponent}}}"


def _index(text: str) -> str:
    """Return an index: a word upright, letters and numbers as they are."""
    text = text.strip("{}")
    if len(text) > 2 and text.isalpha():
        return rf"\mathrm{{{text}}}"
    return "".join(rf"\{_GREEK[c]} " if c in _GREEK else c for c in text)


def display(text: str) -> str:
    """Return the lines of a formula on its own as TeX.

    Raises:
        NotMath: a line is none.
    """
    lines = [tex(line, words=True) for line in text.strip("\n").splitlines() if line.strip()]
    return r"\begin{aligned}" + r" \\ ".join(f"& {line}" for line in lines) + r"\end{aligned}"


class _Typesetter(Treeprocessor):
    """Changes the elements of a page that is marked."""

    def run(self, root: etree.Element) -> None:
        """Typeset the page."""
        stash = map(str, getattr(self.md, "htmlStash").rawHtmlBlocks)
        if not any(f"<!-- {MARK} -->" in block for block in stash):
            return
        for parent in list(root.iter()):
            for child in list(parent):
                inequality = child.tag == "strong" and re.search("[<>]=", child.text or "")
                if (child.tag == "code" and parent.tag != "pre") or (inequality and not len(child)):
                    _replace(child, child.text or "")
        _fold_tests(root)
        for element in list(root.iter()):
            if element.tag not in ("code", "pre", "details") and not element.get("class"):
                _set_symbols(element)
        _split_proofs(root)
        _frame_statements(root)


class _Displays(Treeprocessor):
    """Typesets indented blocks, before they are highlighted as code."""

    def run(self, root: etree.Element) -> None:
        """Typeset the formulas that stand on lines of their own."""
        stash = map(str, getattr(self.md, "htmlStash").rawHtmlBlocks)
        if not any(f"<!-- {MARK} -->" in block for block in stash):
            return
        for element in root.iter("pre"):
            if len(element) == 1 and element[0].tag == "code":
                try:
                    formula = display(_plain(element[0].text or ""))
                except NotMath:
                    continue
                # Atomic, so that no `_` in it begins an emphasis.
                element.tag, element.text = "div", AtomicString(rf"\[{formula}\]")
                element.remove(element[0])
                element.set("class", "formula")


def _replace(code: etree.Element, text: str) -> None:
    """Turn code into a formula where it is one."""
    try:
        formula = tex(_plain(text))
    except NotMath:
        return
    code.tag, code.text = "span", rf"\({formula}\)"
    code.set("class", "formula")


def _set_symbols(element: etree.Element) -> None:
    """Typeset the symbols in the text of an element, and between its parts."""
    for place in range(len(element), -1, -1):
        before = element[place - 1] if place else None
        text = (element.text if before is None else before.tail) or ""
        first, *parts = _cut(text)
        if before is None:
            element.text = first
        else:
            before.tail = first
        element[place:place] = parts if not isinstance(text, AtomicString) else []


def _cut(text: str) -> list[Any]:
    """Return the text before the first symbol, then an element for each with its text after it."""
    if isinstance(text, AtomicString):
        return [text]
    pieces, end = list[Any]([text]), len(text)
    for found in reversed(list(_SYMBOL.finditer(text))):
        part = etree.Element("span", {"class": "formula"})
        part.text, part.tail = rf"\({tex(found[0])}\)", text[found.end() : end]
        pieces[1:1] = [part]
        pieces[0], end = text[: found.start()], found.start()
    return pieces


def _split_proofs(root: etree.Element) -> None:
    """Let proofs begin a paragraph."""
    for element in list(root):
        marks = [k for k, part in enumerate(element) if part.tag == "em" and part.text == "Proof."]
        if element.tag != "p" or not marks or _starts(element, "em", "Proof"):
            continue
        proof = etree.Element("p")
        proof.extend(element[marks[0] :])
        del element[marks[0] :]
        root.insert(list(root).index(element) + 1, proof)


def _plain(text: str) -> str:
    """Return the text that HTML's escapes stand for."""
    return text.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")


def _starts(element: etree.Element, tag: str, text: str) -> bool:
    """Tell whether a paragraph begins with a marked text."""
    first = element[0] if len(element) and not (element.text or "").strip() else None
    return first is not None and first.tag == tag and bool(re.match(text, first.text or ""))


def _fold_tests(root: etree.Element) -> None:
    """Fold the paragraphs that list tests."""
    for element in root:
        if element.tag == "p" and _starts(element, "em", "Tests:"):
            rest = etree.Element("p")
            rest.text = element[0].tail
            rest.extend(list(element)[1:])
            summary = etree.Element("summary")
            summary.text = "Tests"
            element[:] = [summary, rest]
            element.tag, element.text = "details", None


def _frame_statements(root: etree.Element) -> None:
    """Put what states a theorem into a frame, with the list that it ends in."""
    _frame_until_proofs(root)
    kinds = r"(Definition|Theorem|Assumption \d|Lemma|Remark|The corollary|Algorithm)\b"
    expected, framed, previous = False, list[etree.Element](), root
    for element in root:
        title = "".join(element.itertext()) if element.tag in ("h2", "h3") else ""
        if title:
            expected = bool(re.match(kinds, title))
        stated = element.tag == "p" and _starts(element, "strong", "(Theorem|Statement)")
        if stated or (expected and element.tag == "p"):
            framed.append(etree.Element("div", {"class": "statement"}))
            framed[-1].append(element)
            previous, expected = framed[-1], False
        elif previous.get("class") == "statement" and _continues(element):
            previous.append(element)
        else:
            framed.append(element)
            previous = element
    root[:] = framed


def _continues(element: etree.Element) -> bool:
    """Tell whether an element belongs to the statement before it."""
    return element.tag == "ol" or element.get("class") == "formula"


def _frame_until_proofs(root: etree.Element) -> None:
    """Frame what stands between the heading of a theorem and its proof, where that is short."""
    for element in list(root):
        title = "".join(element.itertext()) if element.tag == "h3" else ""
        if not re.match(r"T\d:", title):
            continue
        begin = list(root).index(element) + 1
        proofs = [j for j in range(1, 5) if _starts(root[begin + j], "em", "Proof")]
        if proofs:
            frame = etree.Element("div", {"class": "statement"})
            frame.extend(root[begin : begin + proofs[0]])
            root[begin : begin + proofs[0]] = [frame]


class Formulas(Extension):
    """Adds both to Python-Markdown: displays before the highlighter, the rest after the text."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register the processors."""
        md.treeprocessors.register(_Displays(md), "formula-displays", 40)
        md.treeprocessors.register(_Typesetter(md), "formulas", 15)


def makeExtension(**options: object) -> Formulas:
    """Return the extension, as Python-Markdown asks for it by the name of this module."""
    return Formulas(**options)
