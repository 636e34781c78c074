"""Map the rooms at the top level to sub-packages of ``obsynth``.

Sub-packages of a room have to be found, which static metadata cannot do for
mapped folders; everything else is in ``pyproject.toml``.
"""

from setuptools import find_packages, setup

ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate")

packages = ["obsynth", "obsynth.commands"]
package_dir = {"obsynth": "src/obsynth", "obsynth.commands": "src/obsynth/commands"}
for room in ROOMS:
    packages.append(f"obsynth.{room}")
    packages += [f"obsynth.{room}.{sub}" for sub in find_packages(room)]
    package_dir[f"obsynth.{room}"] = room

setup(packages=packages, package_dir=package_dir)
