from . import welch_analysis as welch_analysis
from ._estimate import FrequencyResponseError as FrequencyResponseError
from ._estimate import SettingsError as SettingsError
from ._estimate import estimate as estimate
from ._fit import FrfFit as FrfFit
from ._fit import fit_frf as fit_frf
from ._fit import fit_many as fit_many
from ._fit import representative_points as representative_points
