"""The description of the package: README.md without pictures and without links to files of the repository."""

import re
from pathlib import Path

from setuptools import setup

text = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
parts = re.split(r"(^```.*?^```)", text, flags=re.DOTALL | re.MULTILINE)  # prose, code, prose, ...
for i in range(0, len(parts), 2):
    parts[i] = re.sub(r"^(\[!\[.*?\]\(.*?\)\]|!\[.*?\])\(.*?\)\n+", "", parts[i], flags=re.MULTILINE)
    parts[i] = re.sub(r"\[([^\]]+)\]\((?!https?://)[^)]+\)", r"\1", parts[i])
setup(long_description="".join(parts), long_description_content_type="text/markdown")
