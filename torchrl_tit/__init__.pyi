from torchrl_tit.agents import load_agent as load_agent
from torchrl_tit.modules import Backbone as Backbone
from torchrl_tit.networks import EnhancedTIT as EnhancedTIT
from torchrl_tit.networks import HistoryNetwork as HistoryNetwork
from torchrl_tit.networks import VanillaTIT as VanillaTIT
from torchrl_tit.settings import Inner as Inner
from torchrl_tit.settings import Outer as Outer
from torchrl_tit.settings import PairedOuter as PairedOuter
from torchrl_tit.transforms import History as History

__version__: str
