"""The dual-stream network: motion window, previous deformation and memory bank in, residuals out."""

from dsar.network.model import STREAMS as STREAMS
from dsar.network.model import DualStreamNetwork as DualStreamNetwork
from dsar.network.model import NetworkOutput as NetworkOutput
from dsar.network.model import Stream as Stream
from dsar.network.state import NetworkState as NetworkState
