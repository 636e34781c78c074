"""What the user says: plants, signals, equations, scenarios."""

from obsynth.symbolic import plants as plants
from obsynth.symbolic import records as records
from obsynth.symbolic import scenarios as scenarios
from obsynth.symbolic.convert import nearest_double as nearest_double
from obsynth.symbolic.convert import to_sx as to_sx
from obsynth.symbolic.errors import ObsynthError as ObsynthError
from obsynth.symbolic.errors import ObsynthWarning as ObsynthWarning
from obsynth.symbolic.errors import PlantError as PlantError
from obsynth.symbolic.errors import RecordError as RecordError
from obsynth.symbolic.functions import phi1 as phi1
from obsynth.symbolic.functions import tanhc as tanhc
from obsynth.symbolic.plant import Plant as Plant
from obsynth.symbolic.plant_file import read_plant as read_plant
from obsynth.symbolic.reading import read_record as read_record
from obsynth.symbolic.record import Record as Record
from obsynth.symbolic.scenario import Scenario as Scenario
from obsynth.symbolic.signals import Role as Role
from obsynth.symbolic.signals import Signal as Signal
from obsynth.symbolic.sxmodel import ParityError as ParityError
from obsynth.symbolic.sxmodel import SxModel as SxModel
from obsynth.symbolic.sxmodel import check_parity as check_parity
from obsynth.symbolic.tape import from_tape as from_tape
from obsynth.symbolic.text import TextError as TextError
from obsynth.symbolic.text import read_text as read_text
from obsynth.symbolic.text import write_text as write_text
