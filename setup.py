"""Which packages the wheel carries; everything else stands in pyproject.toml.

`recipes` is a top-level folder of a clone. A wheel that put a top-level package of so common a name
into site-packages would clash with others, so it is installed as `torchrl_tit.recipes`.
"""

from setuptools import find_packages, setup

library = find_packages(include=["torchrl_tit", "torchrl_tit.*"])
recipes = find_packages(include=["recipes", "recipes.*"])

setup(
    packages=[*library, *(f"torchrl_tit.{name}" for name in recipes)],
    package_dir={"torchrl_tit.recipes": "recipes"},
    package_data={
        "torchrl_tit": ["py.typed"],
        "torchrl_tit.agents": ["*/*.json", "*/*.md", "*/*.safetensors"],
        "torchrl_tit.recipes": [
            "tools/*/*.csv",
            "tools/*/*.html",
            "tools/*/*.json",
            "tools/*/*.md",
        ],
    },
)
