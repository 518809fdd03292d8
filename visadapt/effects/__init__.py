"""Effects: everything that separates the target from the source.

The names of this package are those that the modules list in `__all__`: their effects, and what one's own derive from.
The catalogue, the command line and the diagnosis find an effect in `EFFECTS`, where it registers itself.

>>> import visadapt as va
>>> sorted(va.effects.EFFECTS)[:3]
['actuator_backlash', 'actuator_bias', 'actuator_deadzone']
"""

from visadapt.effects.actuation import *
from visadapt.effects.aerial import *
from visadapt.effects.base import *
from visadapt.effects.camera import *
from visadapt.effects.forces import *
from visadapt.effects.friction import *
from visadapt.effects.hinge import *
from visadapt.effects.late_sensors import *
from visadapt.effects.parameters import *
from visadapt.effects.residual import *
from visadapt.effects.sensing import *
from visadapt.effects.vehicle import *
from visadapt.effects.vehicle_sensors import *
from visadapt.effects.wing import *
