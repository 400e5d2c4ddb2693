"""The readme of the package: README.md without what needs the files around it."""

import re
from pathlib import Path

from setuptools import setup

text = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
text = re.sub(r"^!\[.*?\]\(.*?\)\n+", "", text, flags=re.MULTILINE)  # pictures
text = re.sub(r"\[([^\]]+)\]\((?!https?://)[^)]+\)", r"\1", text)  # links to files and headings
setup(long_description=text, long_description_content_type="text/markdown")
