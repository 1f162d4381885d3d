from .bundle_adjustment import BundleAdjustmentResult as BundleAdjustmentResult
from .bundle_adjustment import adjust_bundle as adjust_bundle
from .cheirality import Cheirality as Cheirality
from .config import BundleAdjustmentConfig as BundleAdjustmentConfig
from .depth import DepthUncertainty as DepthUncertainty
