"""`configs/` is installed as `jvr/configs/`; everything else is said in pyproject.toml."""

from setuptools import find_packages, setup

setup(packages=[*find_packages(include=["jvr*"]), "jvr.configs"], package_dir={"jvr.configs": "configs"})
