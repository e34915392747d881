"""Turns the roles in docstrings, such as ``:class:`~package.module.Name```, into links."""

import re
from typing import Any

_ROLE = re.compile(r":(?:class|func|meth|mod|attr):<code>(~?)([\w.]+)</code>")


def on_page_content(html: str, **page: Any) -> str:
    """Replaces the roles on a page by references, which the plugin autorefs resolves."""

    def link(role: re.Match[str]) -> str:
        tilde, target = role.groups()
        shown = target.rpartition(".")[2] if tilde else target
        return f'<autoref optional identifier="{target}"><code>{shown}</code></autoref>'

    return _ROLE.sub(link, html)
