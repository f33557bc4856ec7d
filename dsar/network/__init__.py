"""The dual-stream network: motion window, previous deformation and memory bank in, residuals out."""

from dsar.network.build import build_network as build_network
from dsar.network.model import DualStreamNetwork as DualStreamNetwork
from dsar.network.model import NetworkOutput as NetworkOutput
from dsar.network.state import STREAMS as STREAMS
from dsar.network.state import NetworkState as NetworkState
from dsar.network.state import Stream as Stream
