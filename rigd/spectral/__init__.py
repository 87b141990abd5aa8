"""Frequency response estimates from sampled records: Welch (H1, H2, Hv, Hiv), whole-record FFT.

Welch's also while the record grows (`rigd.spectral._running`), and a spectrogram that does
(`rigd.spectral._spectrogram`).
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
