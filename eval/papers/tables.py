"""What the papers print, as data: each table with its number, for the scenes and machines of its authors.

Transcribed from the papers' texts. These have no plots, so RAE's Fig. 12, SVGF's Fig. 8 and 10, WSKP's Fig. 6, 9 and 10
and NTD's Fig. 8 are not here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from datasets.frame import Signal

Scores = tuple[float, ...]  # one for each scene
Where = Literal["eval", "bench", "ablation"]


@dataclass(frozen=True)
class PaperTable:
    """A table.

    Attributes:
        values: by method and metric, in the order of `scenes`.
        ours: what the methods that are here too are called here.
        where: the command whose results are compared with it.
        signal: the light that it is of.
        incomparable: metrics that are shown and never compared.
    """

    source: str
    scenes: tuple[str, ...]
    values: Mapping[str, Mapping[str, Scores]]
    ours: Mapping[str, str]
    where: Where = "eval"
    signal: Signal = "total"
    notes: tuple[str, ...] = ()
    incomparable: tuple[str, ...] = ()

    @property
    def metrics(self) -> tuple[str, ...]:
        return tuple(next(iter(self.values.values())))

    @property
    def comparable(self) -> tuple[str, ...]:
        """The metrics that ours can be compared by."""
        return tuple(metric for metric in self.metrics if metric not in self.incomparable)

    def mean(self, method: str, metric: str) -> float:
        """Over the scenes."""
        return sum(self.values[method][metric]) / len(self.scenes)


RAE_FIG_8 = PaperTable(
    "RAE (Chaitanya et al. 2017), Fig. 8",
    ("CornellBox", "Sponza", "GlossySponza", "SanMiguel", "Classroom"),
    {
        "AAF": {"rmse": (0.018, 0.029, 0.069, 0.079, 0.064), "ssim": (0.978, 0.869, 0.664, 0.774, 0.786)},
        "EAW": {"rmse": (0.019, 0.043, 0.089, 0.088, 0.059), "ssim": (0.978, 0.902, 0.586, 0.768, 0.841)},
        "SBF": {"rmse": (0.044, 0.060, 0.057, 0.087, 0.072), "ssim": (0.818, 0.502, 0.649, 0.575, 0.610)},
        "Our": {"rmse": (0.014, 0.016, 0.034, 0.055, 0.040), "ssim": (0.984, 0.953, 0.843, 0.844, 0.909)},
    },
    {"AAF": "aaf", "EAW": "eaw", "SBF": "sbf", "Our": "rae"},
    notes=("The paper's EAW filters single frames, as sbf does; eaw filters accumulated ones.",),
)

RAE_TIMES = PaperTable(
    "RAE (Chaitanya et al. 2017), §5.5, in the text",
    ("1280 × 720",),
    {
        "EAW": {"ms": (10.3,)},
        "Our": {"ms": (54.9,)},
        "SBF": {"ms": (74.2,)},
        "AAF": {"ms": (211.0,)},
        "LBF": {"ms": (1550.0,)},
        "NFOR": {"ms": (114_000.0,)},
    },
    {"EAW": "eaw", "Our": "rae", "SBF": "sbf", "LBF": "lbf", "NFOR": "nfor"},
    where="bench",
    notes=("The paper's machine is a Titan X (Pascal); NFOR's a Core i7-7700HQ: the middle of 107 to 121 s.",),
)

SVGF_TABLE_1 = PaperTable(
    "SVGF (Schied et al. 2017), Table 1",
    ("Sponza", "GlossySponza", "RedRoom", "SanMiguel", "Classroom"),
    {
        "Ours": {"rmse": (0.022, 0.049, 0.021, 0.059, 0.027), "ssim": (0.947, 0.779, 0.972, 0.863, 0.940)},
        "EAW alone": {"rmse": (0.043, 0.089, 0.049, 0.088, 0.059), "ssim": (0.902, 0.585, 0.923, 0.767, 0.841)},
        "EAW": {"rmse": (0.040, 0.087, 0.048, 0.070, 0.052), "ssim": (0.909, 0.586, 0.924, 0.818, 0.876)},
        "LBF alone": {"rmse": (0.032, 0.058, 0.033, 0.074, 0.047), "ssim": (0.777, 0.655, 0.915, 0.651, 0.787)},
        "LBF": {"rmse": (0.022, 0.052, 0.031, 0.058, 0.035), "ssim": (0.924, 0.764, 0.946, 0.833, 0.912)},
        "SBF alone": {"rmse": (0.060, 0.058, 0.038, 0.088, 0.072), "ssim": (0.500, 0.648, 0.822, 0.571, 0.610)},
        "SBF": {"rmse": (0.031, 0.048, 0.027, 0.061, 0.035), "ssim": (0.858, 0.757, 0.957, 0.815, 0.884)},
    },
    {"Ours": "svgf", "EAW": "eaw", "LBF alone": "lbf", "SBF alone": "sbf"},
    notes=(
        "EAW, LBF and SBF filter accumulated frames (in parentheses in the paper), those called alone single ones.",
        "The paper's LBF has its authors' weights, trained for 4 to 64 samples a pixel; lbf has ours.",
        "The caption says that SVGF is never worse. By its RMSE, SBF is better on GlossySponza and LBF on SanMiguel.",
    ),
)

BMFR_SCENES = ("Classroom", "Living room", "San Miguel", "Sponza", "Sponza (glossy)", "Sponza (mov. light)")
WSKP_OURS = {
    "NFOR": "nfor",
    "BMFR": "bmfr",
    "SVGF": "svgf",
    "MR-KP": "mr-kp",
    "KP": "kp",
    "NBGD": "nbgd",
    "Ours (6-layer)": "wskp6",
    "Ours (3-layer)": "wskp3",
}

WSKP_TABLE_1 = PaperTable(
    "WSKP (Fan et al. 2021), Table 1",
    BMFR_SCENES,
    {
        "NFOR": {"psnr": (29.872, 31.304, 21.811, 30.377, 25.974, 21.999)},
        "BMFR": {"psnr": (28.965, 30.025, 20.969, 31.111, 25.005, 17.377)},
        "ONND": {"psnr": (27.312, 25.586, 20.172, 24.698, 23.460, 22.291)},
        "SVGF": {"psnr": (25.034, 27.239, 18.736, 24.401, 20.917, 17.260)},
        "MR-KP": {"psnr": (33.030, 33.832, 24.047, 34.730, 30.923, 25.372)},
        "KP": {"psnr": (33.047, 34.090, 24.215, 34.595, 30.719, 25.324)},
        "NBGD": {"psnr": (31.534, 32.506, 23.807, 33.412, 29.678, 24.866)},
        "Ours (6-layer)": {"psnr": (32.827, 34.063, 24.269, 34.600, 30.805, 25.374)},
        "Ours (3-layer)": {"psnr": (32.220, 32.913, 23.860, 33.796, 29.981, 25.050)},
    },
    WSKP_OURS,
    notes=("The paper's own average of NBGD is 29.474, not that of the row, 29.301.",),
)

WSKP_TABLE_2 = PaperTable(
    "WSKP (Fan et al. 2021), Table 2",
    BMFR_SCENES,
    {
        "NFOR": {"ssim": (0.956, 0.967, 0.799, 0.939, 0.901, 0.895)},
        "BMFR": {"ssim": (0.955, 0.965, 0.789, 0.948, 0.907, 0.858)},
        "ONND": {"ssim": (0.924, 0.953, 0.744, 0.852, 0.867, 0.811)},
        "SVGF": {"ssim": (0.952, 0.950, 0.790, 0.927, 0.913, 0.876)},
        "MR-KP": {"ssim": (0.978, 0.977, 0.851, 0.982, 0.962, 0.961)},
        "KP": {"ssim": (0.978, 0.978, 0.851, 0.982, 0.960, 0.958)},
        "NBGD": {"ssim": (0.967, 0.971, 0.833, 0.975, 0.946, 0.947)},
        "Ours (6-layer)": {"ssim": (0.977, 0.979, 0.849, 0.983, 0.961, 0.958)},
        "Ours (3-layer)": {"ssim": (0.973, 0.973, 0.841, 0.979, 0.955, 0.953)},
    },
    WSKP_OURS,
)

# The averages that Tables 1 and 2 print themselves, to check what was transcribed.
WSKP_AVERAGES = {
    "psnr": (26.889, 25.575, 23.920, 22.264, 30.322, 30.332, 29.474, 30.323, 29.637),
    "ssim": (0.910, 0.904, 0.858, 0.901, 0.952, 0.951, 0.940, 0.951, 0.946),
}

WSKP_TABLE_3 = PaperTable(
    "WSKP (Fan et al. 2021), Table 3",
    ("1280 × 720",),
    {
        "Ours 3-layer": {"ms": (6.58,), "prediction": (5.47,), "reconstruction": (1.11,)},
        "Ours 6-layer": {"ms": (12.89,), "prediction": (11.75,), "reconstruction": (1.14,)},
        "Ours MR": {"ms": (22.70,), "prediction": (21.85,), "reconstruction": (0.85,)},
        "NBGD 2-layer": {"ms": (13.97,), "prediction": (7.84,), "reconstruction": (6.13,)},
        "NBGD 7-layer": {"ms": (50.28,), "prediction": (44.16,), "reconstruction": (6.12,)},
        "KP": {"ms": (27.86,), "prediction": (26.23,), "reconstruction": (1.22,)},
        "MR-KP": {"ms": (24.73,), "prediction": (23.73,), "reconstruction": (1.00,)},
        "BMFR": {"ms": (1.60,)},
        "SVGF": {"ms": (4.40,)},
        "ONND": {"ms": (55.00,)},
        "NFOR": {"ms": (370.00,)},
    },
    {
        "Ours 3-layer": "wskp3",
        "Ours 6-layer": "wskp6",
        "Ours MR": "wskp-mr",
        "NBGD 2-layer": "nbgd",
        "KP": "kp",
        "MR-KP": "mr-kp",
        "BMFR": "bmfr",
        "SVGF": "svgf",
        "NFOR": "nfor",
    },
    where="bench",
    notes=(
        "The paper's machine is an RTX 2080 Ti; for BMFR an RTX 2080, SVGF and ONND a Titan X, NFOR a Core i7-8700.",
        "KP's two parts add up to 27.45 ms, not to the 27.86 ms that the paper prints.",
        "Our prediction is the network alone, our reconstruction all the rest: accumulation too.",
    ),
    incomparable=("reconstruction",),
)

WSKP_TABLE_5 = PaperTable(
    "WSKP (Fan et al. 2021), Table 5",
    ("Living room", "Sponza"),
    {
        "Ours w/o RepVGG": {"psnr": (33.470, 33.925), "ssim": (0.9754, 0.9813)},
        "Ours w/ RepVGG": {"psnr": (34.063, 34.600), "ssim": (0.9789, 0.9830)},
        "KP w/o RepVGG": {"psnr": (33.962, 34.541), "ssim": (0.9771, 0.9829)},
        "KP w/ RepVGG": {"psnr": (34.090, 34.595), "ssim": (0.9781, 0.9830)},
    },
    {
        "Ours w/o RepVGG": "wskp6-plain",
        "Ours w/ RepVGG": "wskp6",
        "KP w/o RepVGG": "kp-plain",
        "KP w/ RepVGG": "kp",
    },
    where="ablation",
)

NTD_TABLE_2 = PaperTable(
    "NTD (Zeng et al.), Table 2",
    ("1390 test frames",),
    {
        "SVGF": {"psnr": (69.7086,), "ssim": (0.6517,), "l1": (0.0652,), "mse": (0.0087,)},
        "TRMV": {"psnr": (78.4319,), "ssim": (0.8960,), "l1": (0.0215,), "mse": (0.0007,)},
        "NTASD": {"psnr": (77.7679,), "ssim": (0.8983,), "l1": (0.0283,), "mse": (0.0009,)},
        "Ours": {"psnr": (80.1891,), "ssim": (0.9115,), "l1": (0.0206,), "mse": (0.0002,)},
    },
    {"SVGF": "svgf", "TRMV": "trmv", "Ours": "ntd"},
    signal="indirect",
    notes=(
        "The PSNRs contradict the MSEs beside them: an MSE of 0.0002 is a PSNR of 37 dB, one of 0.0087 is 21 dB. "
        "They are never compared.",
        "All are of indirect light. svgf and trmv count only where they were evaluated on that.",
    ),
    incomparable=("psnr",),
)

TABLES = (RAE_FIG_8, RAE_TIMES, SVGF_TABLE_1, WSKP_TABLE_1, WSKP_TABLE_2, WSKP_TABLE_3, WSKP_TABLE_5, NTD_TABLE_2)
