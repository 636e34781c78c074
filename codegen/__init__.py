"""What ships: C projects of one observer step."""

from obsynth.codegen.build import Build as Build
from obsynth.codegen.build import Comparison as Comparison
from obsynth.codegen.build import build_and_compare as build_and_compare
from obsynth.codegen.build import find_compiler as find_compiler
from obsynth.codegen.errors import BuildError as BuildError
from obsynth.codegen.errors import CodegenError as CodegenError
from obsynth.codegen.errors import ComparisonError as ComparisonError
from obsynth.codegen.errors import FolderError as FolderError
from obsynth.codegen.fmu import Fmu as Fmu
from obsynth.codegen.fmu import generate_fmu as generate_fmu
from obsynth.codegen.project import CProject as CProject
from obsynth.codegen.project import generate_c as generate_c
