"""Text of reports and pages is readable: its contrast is at least 4.5 to 1 (WCAG 2.2, level AA)."""

import re
from pathlib import Path

import pytest

import splatax

ROOT = Path(splatax.__file__).parent
LEAST = 4.5
# Backgrounds that browsers give a page without one of its own. Dark: Chrome, Firefox and Safari.
LIGHT, DARK = ("#ffffff",), ("#121212", "#1c1b22", "#1e1e1e")
DARK_SCHEME = re.compile(r"@media \(prefers-color-scheme: dark\) \{ (:root \{[^}]*\}) \}")


def channels(color):
    """RGB and alpha of #rgb, #rgba, #rrggbb or #rrggbbaa, each in [0, 1]."""
    digits = color.removeprefix("#")
    if len(digits) in (3, 4):
        digits = "".join(2 * digit for digit in digits)
    *rgb, alpha = (int(digits.ljust(8, "f")[i : i + 2], 16) / 255 for i in (0, 2, 4, 6))
    return rgb, alpha


def over(color, background):
    """The opaque RGB of a colour in front of an opaque background."""
    (rgb, alpha), (behind, _) = channels(color), channels(background)
    return [alpha * front + (1 - alpha) * back for front, back in zip(rgb, behind, strict=True)]


def luminance(rgb):
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(first, second):
    dark, light = sorted((luminance(first), luminance(second)))
    return (light + 0.05) / (dark + 0.05)


def variables(css):
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]+)", css))


def text_colors(css):
    """Every value of the property `color`, as written."""
    return re.findall(r"(?<![\w-])color: ([^;}]+)", css)


def resolved(color, names):
    variable = re.fullmatch(r"var\(--([\w-]+)\)", color)
    return names[variable[1]] if variable else color


def test_contrast_of_known_colours():
    assert contrast([0, 0, 0], [1, 1, 1]) == pytest.approx(21)
    assert contrast(over("#767676", "#ffffff"), [1, 1, 1]) == pytest.approx(4.54, abs=0.01)


@pytest.mark.parametrize("template", ["base", "page", "side_by_side", "capture"])
def test_text_of_reports_is_readable_in_light_and_dark(template):
    base = (ROOT / "report" / "base.html").read_text()
    (dark,) = DARK_SCHEME.findall(base)
    light_names = variables(DARK_SCHEME.sub("", base))
    found = text_colors((ROOT / "report" / f"{template}.html").read_text())
    assert found
    for names, backgrounds in ((light_names, LIGHT), (light_names | variables(dark), DARK)):
        for color in found:
            for background in backgrounds:
                shown = resolved(color, names)
                assert contrast(over(shown, background), over(background, background)) >= LEAST, (
                    f"{template}.html: {color} is {shown} on {background}"
                )


def test_text_of_the_page_is_readable_on_its_panels():
    css = (ROOT / "web" / "page.css").read_text()
    names = variables(css)
    texts = {resolved(color, names) for color in text_colors(css)} - {"inherit"}
    # Panels: the screen while loading, the dialog, and glass in front of any scene, at worst a white one.
    (dialog,) = re.findall(r"background: (#181c22\w*)", css)
    for panel in ("#0e1013", dialog, names["glass"]):
        for behind in ("#000000", "#ffffff"):
            for text in texts:
                assert contrast(over(text, behind), over(panel, behind)) >= LEAST, f"{text} on {panel}"
