"""MkDocs hook: make links of notebooks to Markdown pages point to the pages of the site."""

import posixpath
import re
from typing import Any


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Replace the targets of links such as `../concepts.md`; a missing page is an error."""
    if not page.file.src_uri.endswith(".ipynb"):
        return html
    folder = posixpath.dirname(page.file.src_uri)

    def site_link(match: re.Match[str]) -> str:
        target = files.get_file_from_path(posixpath.normpath(posixpath.join(folder, match[1])))
        if target is None:
            raise ValueError(f"{page.file.src_uri}: links to {match[1]}, which does not exist")
        return f'href="{target.url_relative_to(page.file)}"'

    return re.sub(r'href="([^":#]+\.md)"', site_link, html)
