"""The simulated studio: a camera with a zoom lens in a room, an engine on its real wire protocols, a head.

It is the twin of a real studio, so it must not share the mathematics of the code that calibrates it: projection,
distortion and drawing are its own (:mod:`.optics`, :mod:`.render`) and only the written conventions are common.
"""

import calibration as _calibration  # noqa: F401  (sets OpenCV's bound before any module here imports it)
