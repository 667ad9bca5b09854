"""The list of datasets. A new one is added to both tuples."""

from adapters.av2.dataset import AV2
from adapters.dataset import Dataset
from adapters.drivestudio.dataset import DRIVESTUDIO
from adapters.finished_scenes import GAUSSIANS, SCENE
from adapters.kitti.dataset import KITTI
from adapters.nuscenes.dataset import NUSCENES
from adapters.pandaset.dataset import PANDASET
from adapters.recording.dataset import RECORDING
from adapters.street.dataset import PROCEDURAL
from adapters.street_gaussians.dataset import STREET_GAUSSIANS
from adapters.waymo.dataset import WAYMO

# All datasets by scheme, in the order in which messages list them.
DATASETS: dict[str, Dataset] = {
    dataset.scheme: dataset
    for dataset in (
        PROCEDURAL,
        PANDASET,
        NUSCENES,
        KITTI,
        WAYMO,
        AV2,
        STREET_GAUSSIANS,
        DRIVESTUDIO,
        RECORDING,
        GAUSSIANS,
        SCENE,
    )
}

# The order in which the files and folders of a path are compared with the datasets' signatures. A
# later one may fit where an earlier one does.
RECOGNITION_ORDER = (
    SCENE,
    PANDASET,
    NUSCENES,
    WAYMO,
    STREET_GAUSSIANS,
    DRIVESTUDIO,
    KITTI,
    AV2,
    RECORDING,
    GAUSSIANS,
)
