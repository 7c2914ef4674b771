"""Numbers that the PyTorch version of a filter and its compiled kernel share."""

# --- Reprojection (SVGF §4.1) -----------------------------------------------------------------------------------------

PLANE_TOLERANCE = 0.01  # of the depth: a tap's surface may lie this far off the point's plane
NORMAL_TOLERANCE = 0.9  # smallest cosine between a tap's normal and the point's

# --- Accumulation (SVGF §4.1) -----------------------------------------------------------------------------------------

SMALLEST_ALPHA = 0.2  # weight of the newest frame in a long history

# --- SVGF (Schied et al. 2017) ----------------------------------------------------------------------------------------

ALPHA = 0.2  # §4.1: weight of the newest sample
LARGEST_LUMINANCE = 1e16  # its square must stay finite
SPATIAL_RADIUS = 3  # §4.2: windows of 7 x 7
SIGMA_Z = 1.0  # §4.4
SIGMA_L = 4.0
SQUARINGS = 7  # σ_n = 128 = 2^7
EPSILON_Z = 1e-3  # of the depth
EPSILON_L = 1e-20  # luminance²
LEAST_DIVISOR = 1e-30  # keeps quotients finite where lengths and depths are 0

# --- BMFR (Koskela et al. 2019) ---------------------------------------------------------------------------------------

BLOCK_SIDE = 32  # px
REGRESSORS = 10  # 1, normal (3), position (3), its squares (3)
FLATTEST = 1e-3  # of a block's largest extent: what is smaller along an axis is not stretched to 1

# --- AAF (Mehta et al. 2012, 2013) ------------------------------------------------------------------------------------

DIFFUSE_BAND = 2.8  # band limit of what diffuse surfaces reflect, times the distance of that
AAF_REACH = 50  # px
AAF_TRUNCATION = 8**0.5  # standard deviations at which Gaussians end
AAF_LEAST_COSINE = 0.99619  # of 5°, between normals

# --- Weight-shared kernels (Fan et al. 2021) --------------------------------------------------------------------------

WINDOWS = (3, 5, 7, 9, 11, 13)  # §5.3
FEATURES = {"colour": 3, "albedo": 3, "normal": 3, "depth": 1}  # what the network sees (§5.1), and how many inputs
GAMMA = 2.2  # of the display transform before the network (§5.1)
SAFE_RANGE = 80.0  # of logits: exp(±40) times any radiance, summed, neither overflows nor vanishes in float32
LEAST_EXPONENT = -80.0  # exp of less is denormal in float32, which is slow; what it leaves is 1e-35
OUTSIDE = -1e30  # logit of a tap outside the image, or without a surface
LEAST_WEIGHT = 1e-30  # no sum of weights is smaller but 0

# --- NBGD (Meng et al. 2020) ------------------------------------------------------------------------------------------

GUIDES = 256  # values of a guide, which cells of a grid divide as they divide pixels

# --- LBF (Kalantari et al. 2015) --------------------------------------------------------------------------------------

FILTER_RADIUS = 27  # px: windows of 55 x 55
GROUPS = (3, 3, 3, 1, 1)  # channels of each feature: position, normal, albedo, roughness, visibility
COLOUR_SHARPNESS = 1 / (2 * 7**2)  # 1 / 2 β²
LEAST_VARIANCE = 1e-30  # of colours, to divide by; far below that of any noise
LARGEST_EXPONENT = 80.0  # what would weigh less than exp(-80) counts as that much

# --- one --------------------------------------------------------------------------------------------------------------

LATENT = 6  # channels carried beside images, in [-1, 1]
ONE_INPUTS = {"images": 15, "history": 4, "latent": LATENT, "surfaces": 8}  # what the network sees, and how many inputs
STEPS = (32, 16, 8, 4, 2, 1)  # px between taps of the filter: the last levels smooth the pattern that the first leave
COMPARED = 8  # features that pixels are compared by
BRIGHTEST = 1e13  # exposed irradiance that `one` tells apart; what is brighter looks alike to the network
LARGEST_IRRADIANCE = 1e30  # what is brighter is cut: sums of it with weights of exp(10) must stay finite
LARGEST_LOGIT = 10.0  # of the weights of taps
LEAST_LOGIT = -40.0  # what is below counts as that much
MULTIPLE = 8  # of the sides of an image that the network takes
FEWEST_SAMPLES = 1e-3  # of a history, to divide by
LEAST_MEAN = 1e-20  # luminance that deviations are relative to


def outputs_of_one(levels: int) -> tuple[int, ...]:
    """How many outputs of the network belong to what: features, three of each level, two weights, latent channels."""
    return COMPARED, levels, levels, levels, 2, LATENT
