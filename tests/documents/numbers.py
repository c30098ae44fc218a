"""Numbers of a page that may be measurements: those with a unit, and decimals in tables of figures."""

import re

_ONE = r"-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?"
_UNIT = r"(?:dB|cm|mm|%|ms|s|seconds?|MiB|GiB|x|times|-fold)"
WITH_UNIT = re.compile(
    rf"(?<![\w.,/^=-]){_ONE}(?:(?: to | and | or | / |, |-){_ONE})*(?: |(?=[%x-])){_UNIT}(?!\w| ?\d)"
)
DECIMAL = re.compile(r"(?<![\w.,^=-])-?\d[\d,]*\.\d+(?![\w.])")
GENERATED = re.compile(r"<!-- results: .*?<!-- end of results -->", re.DOTALL)
MARKED = re.compile(rf"{_ONE}\**<!-- figure: .*?-->(?: ?{_UNIT}(?!\w))?")
CODE = re.compile(r"^ *```.*?^ *```|`[^`\n]*`", re.DOTALL | re.MULTILINE)
TABLE = re.compile(r"^\|(?P<head>.*)\n\|[-:| ]+\n(?P<rows>(?:\|.*\n)+)", re.MULTILINE)
OF_FIGURES = re.compile(r"PSNR|SSIM|error|\((?:dB|cm|mm|%|ms|s)\)|CPU|views/s|seconds")


def unmarked(text: str, allowed: tuple[str, ...] = ()) -> list[str]:
    """Return what looks like a measurement and has no source, in the order of the page; ``allowed`` is left out."""
    for gone in (GENERATED, MARKED, CODE):
        text = gone.sub("", text)
    text = re.sub(r"(?<!\|)\n(?![\n|])", " ", text)  # a line's end is a blank; tables keep their rows
    for words in sorted(allowed, key=len, reverse=True):
        text = text.replace(words, "")
    found = [match[0] for match in WITH_UNIT.finditer(text)]
    for table in TABLE.finditer(text):
        if OF_FIGURES.search(table["head"]):
            found += DECIMAL.findall(table["rows"])
    return found
