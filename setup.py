"""Install the data that pyproject.toml cannot describe.

The top-level configs/ and the photos of the sample scene are installed inside the package. The
templates of new plugins are data although they look like code. The long description is the README
without pictures and without links to files of the repository, which package indexes cannot show.
"""

import re
from pathlib import Path

from setuptools import find_packages, setup

DATA = {
    "mpsfm_core.configs": "configs",
    "mpsfm_core.sample_scene.images": "examples/sample_scene/images",
    "mpsfm_core.sample_scene.gt": "examples/sample_scene/gt",
}


def long_description() -> str:
    """Return the README without pictures, and with the text of links to files only."""
    text = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
    text = re.sub(r"^!\[[^]]*\]\([^)]*\)\n+", "", text, flags=re.MULTILINE)
    return re.sub(r"\[([^]]+)\]\((?!https?:)[^)]*\)", r"\1", text)


setup(
    long_description=long_description(),
    long_description_content_type="text/markdown",
    packages=[*find_packages(include=["mpsfm_core", "mpsfm_core.*"]), *DATA],
    package_dir=DATA,
    py_modules=["mpsfm_pytest"],
    package_data={
        "mpsfm_core": ["py.typed"],
        "mpsfm_core.configs": ["*.yaml"],
        "mpsfm_core.sample_scene.images": ["*.jpg"],
        "mpsfm_core.sample_scene.gt": ["*.txt"],
        "mpsfm_core.report": ["assets/page.*", "assets/three.min.js", "assets/three.LICENSE"],
        "mpsfm_core.testing": ["templates/*/*", "templates/*/tests/*"],
    },
)
