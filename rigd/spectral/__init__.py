"""Frequency responses estimated from sampled records.

The package offers Welch's estimate (`welch_response`: H1, H2, Hv), the instrumental-variable
estimate within a control loop (`instrumental_response`: Hiv), the ratio of the transforms of whole
records (`fft_response`), Welch's estimate of a record that is still growing (`RunningResponse`), a
running spectrogram (`RunningSpectrogram`) and the decimation of curves (`CurveDecimation`). It
works on arrays and depends on neither sessions nor the beam.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
