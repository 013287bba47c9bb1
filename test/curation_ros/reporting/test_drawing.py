from __future__ import annotations

import pytest

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from curation_ros.reporting.drawing import inline_svg, number_ids


def test_an_inlined_svg_has_ids_of_its_own() -> None:
    svg = (
        '<?xml?><svg a="1"><g id="p1"/><g id="idle"/><use href="#p1"/><g clip="url(#p12)"/></svg>'
    )
    numbered = number_ids(svg)
    assert '<g id="i0"/><g/><use href="#i0"/><g clip="url(#i1)"/>' in numbered
    inlined = inline_svg(numbered, "x", 'say "it" & <go>')
    assert '<g id="x-i0"/><g/><use href="#x-i0"/><g clip="url(#x-i1)"/>' in inlined
    assert 'aria-label="say &quot;it&quot; &amp; &lt;go>"' in inlined
