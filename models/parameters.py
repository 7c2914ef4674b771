"""Numbers that `one`'s PyTorch version and its compiled kernel share."""

LATENT = 6  # channels carried beside images, in [-1, 1]
ONE_INPUTS = {"images": 15, "history": 4, "latent": LATENT, "surfaces": 8}  # what the network sees, and how many inputs
STEPS = (32, 16, 8, 4, 2, 1)  # px between taps of the filter: the last levels smooth the pattern that the first leave
COMPARED = 8  # features that pixels are compared by
BRIGHTEST = 1e13  # exposed irradiance that `one` tells apart; what is brighter looks alike to the network
LARGEST_IRRADIANCE = 1e30  # what is brighter is cut: sums of it with weights of exp(10) must stay finite
LARGEST_LOGIT = 10.0  # of the weights of taps
MULTIPLE = 8  # of the sides of an image that the network takes
FEWEST_SAMPLES = 1e-3  # of a history, to divide by


def outputs_of_one(levels: int) -> tuple[int, ...]:
    """How many outputs of the network belong to what: features, three of each level, two weights, latent channels."""
    return COMPARED, levels, levels, levels, 2, LATENT
