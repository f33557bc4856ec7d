"""The dual-stream network: motion window, previous deformation and memory bank in, residuals out."""

from dsar.network.dual_stream import STREAMS as STREAMS
from dsar.network.dual_stream import DualStreamNetwork as DualStreamNetwork
from dsar.network.dual_stream import NetworkOutput as NetworkOutput
from dsar.network.dual_stream import Stream as Stream
from dsar.network.state import NetworkState as NetworkState
