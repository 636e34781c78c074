"""What ships: C projects of one observer step."""

from obsynth.codegen.build import Build, Comparison, build_and_compare, find_compiler
from obsynth.codegen.errors import BuildError, CodegenError, ComparisonError, FolderError
from obsynth.codegen.project import CProject, generate_c

__all__ = [
    "Build",
    "BuildError",
    "CProject",
    "CodegenError",
    "Comparison",
    "ComparisonError",
    "FolderError",
    "build_and_compare",
    "find_compiler",
    "generate_c",
]
