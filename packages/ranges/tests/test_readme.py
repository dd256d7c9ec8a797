"""The example of the README prints what the README says."""

import contextlib
import io
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def test_the_example_prints_what_the_page_says():
    text, printed = README.read_text("utf-8"), io.StringIO()
    code, expected = (text.split(f"```{kind}\n")[1].split("```")[0] for kind in ("python", "text"))
    with contextlib.redirect_stdout(printed):
        exec(code, {})
    assert printed.getvalue() == expected
