/* onespp.c - see onespp.h.
 *
 * What it computes is models/networks/one.py. A frame takes these steps, each split into tasks by rows:
 *
 *   measure    means of luminance over blocks, for the exposure
 *   enter      reprojection, neighbourhood statistics, inputs of the network, its per-pixel and first layers
 *   layers     the U-Net at 1/2, 1/4 and 1/8 of the resolution
 *   leave      its last layers, decoded into the parameters of the filter and the new accumulation
 *   filter     two levels of an a-trous filter, which spread outliers, all six of it, and four of these guided by
 *              luminance; the last one leaves what the next frame needs
 *   write      the output, whose coarse neighbourhoods get the mean that their samples have
 *
 * `enter` to `leave` work on strips of rows, so that activations take little memory. Strips overlap: what 3 x 3 taps
 * below and above a strip need is computed twice, except for `enter`, whose results are kept from strip to strip.
 *
 * Images are stored in lines: a row of an image is one line of floats per channel, and all loops that matter run along
 * lines, where compilers vectorise them. What reprojection fetches is stored in texels: all channels of a pixel side by
 * side, in one cache line.
 *
 * onespp_avx2.c and onespp_avx512.c compile this file once more for these instruction sets, as far as `Engine` goes; the
 * interface at the end then chooses between the three.
 */
#include "onespp.h"

#include <float.h>
#include <math.h>
#include <string.h>

#if !defined(ONESPP_AVX2) && !defined(ONESPP_AVX512)
#include "onespp_weights.h"
#endif

/* A layer sums LANES pixels of AT_ONCE outputs in registers, see multiply_block. CHUNK pixels of a row are worked on
 * together: what they need stays in the first caches. */
#if defined(__AVX512F__) || defined(ONESPP_AVX512)
enum { LANES = 64, AT_ONCE = 4, CHUNK = 256 };
#elif defined(__AVX2__) || defined(ONESPP_AVX2)
enum { LANES = 24, AT_ONCE = 4, CHUNK = 240 };
#elif defined(__wasm_simd128__)
enum { LANES = 8, AT_ONCE = 4, CHUNK = 256 };
#else
enum { LANES = 24, AT_ONCE = 2, CHUNK = 240 };
#endif

#if defined(__GNUC__)
#define NOINLINE __attribute__((noinline))
#define PREFETCH(address) __builtin_prefetch(address)
#else
#define NOINLINE
#define PREFETCH(address) ((void)(address))
#endif

enum {
    RGB = 3,
    LATENT = 6,   /* channels carried from frame to frame */
    FEATURES = 8, /* that pixels are compared by */
    LEVELS = 6,   /* of the filter */
    SPREADING = 2, /* the first passes, which spread outliers before all levels filter */
    FIRST_GUIDED = SPREADING + LEVELS, /* pass: from it on they are guided by luminance */
    PASSES = FIRST_GUIDED + 4,
    DETAIL = 24,  /* hidden channels of the per-pixel layers */
    PATCH = 4,    /* pixels, 2 x 2 */
    WIDTH_A = 40, /* channels at 1/2 of the resolution */
    WIDTH_B = 56, /* 1/4 */
    WIDTH_C = 64, /* 1/8 */
    REACH_A = 14, /* rows of 1/2 above and below that the network's output depends on */
    REACH_C = 3   /* rows of 1/8 */
};

/* Floats from line to line: an odd multiple of 16, so that lines do not fall on the same sets of a cache. */
#define PITCH(width) ((((width) + 15) / 16 | 1) * 16)

enum {
    HALF_CHUNK = CHUNK / 2,
    MIN_STRIP_ROWS = 64,
    BLOCK = 16,       /* pixels, the side of the squares whose luminance is measured */
    GAIN_DEVIATION = 2, /* blocks, of the Gaussian that weights them where a change of light is looked for */
    TILE = 8,         /* pixels, the side of the squares that coarse neighbourhoods are made of */
    WIDE_DEVIATION = 4, NARROW_DEVIATION = 1, /* tiles, of the Gaussians that weight these */
    REACH = 3,        /* deviations: the radius of Gaussians */
    MAX_GAUSSIAN = 2 * REACH * WIDE_DEVIATION + 1,
    MEDIAN_GRID = 64, /* the median depth of large images is taken from about as many rows and columns */
    MAX_DEPTHS = (2 * MEDIAN_GRID - 1) * (2 * MEDIAN_GRID - 1),
    PAD = 16,   /* floats before a line of activations: alignment, and zeros to the left of the image */
    MARGIN = 64, /* floats before and after other lines: the largest distance of taps of the filter */
    LINE = PITCH(CHUNK),
    HALF_LINE = PITCH(HALF_CHUNK), /* has room for the pixels beside the chunk, too */
    ALIGNMENT = 64, /* bytes: a cache line */
    BACKGROUND = 0 /* mesh id of pixels that show no surface */
};

#ifndef ONESPP_STRIP_PIXELS
#define ONESPP_STRIP_PIXELS (1 << 18) /* smaller strips take less memory, and more time */
#endif

#define MAX_MAGNITUDE 1e35f   /* of a channel: two of them, divided by the smallest albedo, are finite */
#define MAX_REFLECTANCE 100.f /* albedo, roughness and components of normals are clamped: the network stays finite */
#define MAX_IRRADIANCE 1e30f
#define MAX_PART 1e32f /* irradiance of parts of the light, which may cancel each other */
#define MAX_LUMINANCE 1e16f /* its square must be finite */
#define MAX_EXPOSED 1e13f
#define MIDDLE_GREY 0.18f /* the exposed geometric mean of luminance */
#define MIN_MEAN 1e-20f
#define ALBEDO_FLOOR 0.01f
#define MIN_MASS 1e-30f
#define MIN_LENGTH 1e-3f /* samples of a history, to divide by */
#define OUTLIER 8.f /* times the mean over 9 x 9 pixels: what is brighter is spread */
#define MESH_DISTANCE 2.f /* added to the squared distance of features between meshes, which may look alike */
#define GUIDANCE 30.f /* weight of squared differences of the guide beside those of features, for each sample */
#define DARKEST 0.01f /* exposed luminance: what is darker looks alike to guided levels */
#define GAIN_NOISE 3.f /* standard errors: smaller changes of light do not count */
#define COARSE_NOISE 2.f /* the same of residuals */
#define COARSE_DARK 0.3f /* exposed luminance: residuals of what is darker count less than relative ones */
#define COARSE_LEAST 0 /* gain: where no sample has any light, it is black */
#define COARSE_LENGTH 4.f /* frames that residuals are averaged over at most */
#define MAX_GAIN 4.f /* of a neighbourhood, a frame */
#define MIN_CHANGE 1e-30f /* of sums of luminance, to divide by */
#define MAX_LOGIT 10.f
#define MIN_LOGIT -40.f
#define NO_WEIGHT -1e4f /* importance of pixels that show no surface */
#define MAX_EXPONENT 80.f
#define PLANE_TOLERANCE 0.01f /* of the depth: largest distance of a tap's surface from the point's plane */
#define NORMAL_TOLERANCE 0.9f /* smallest cosine between a tap's normal and the point's */

/* Passes of the filter: levels, of which each has weights of its own, and pixels between taps. */
static const int PASS_LEVELS[PASSES] = {0, 1, 0, 1, 2, 3, 4, 5, 0, 1, 3, 5};
static const int TAP_SPACINGS[PASSES] = {64, 16, 32, 16, 8, 4, 2, 1, 64, 16, 4, 1};

/* --- Arithmetic --------------------------------------------------------------------------------------------------- */

static inline float minf(float a, float b) { return a < b ? a : b; }

static inline float maxf(float a, float b) { return a > b ? a : b; }

static inline int mini(int a, int b) { return a < b ? a : b; }

static inline int maxi(int a, int b) { return a > b ? a : b; }

static inline float clamped(float x, float limit) { return maxf(minf(x, limit), -limit); }

/* 0 for NaN and infinities. */
static inline float finite_or_0(float x) { return fabsf(x) <= FLT_MAX ? clamped(x, MAX_MAGNITUDE) : 0; }

static inline int32_t bits_of(float x)
{
    int32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

static inline float float_of(int32_t bits)
{
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* e^x for |x| <= 87, within 3e-7: 2^f on [-1/2, 1/2] is a polynomial. Unlike libm's, compilers vectorise it. */
static inline float exponential(float x)
{
    const float magic = 12582912.f; /* 1.5 * 2^23: adding it rounds to an integer */
    float t = x * 1.4426950408889634f;
    int32_t n = bits_of(t + magic) - bits_of(magic); /* of floats: x87 would not round their difference */
    float f = t - (float)n;
    float p = 0.00967151f + f * 0.00132647f;
    p = 0.05550734f + f * p;
    p = 0.24022242f + f * p;
    p = 0.69314698f + f * p;
    p = 1.f + f * p;
    return float_of(bits_of(p) + n * (1 << 23));
}

/* ln x for normal x = m 2^e, as e ln 2 and the series of 2 artanh((m - 1) / (m + 1)), with m between the roots of 1/2
 * and of 2, where the bits of the latter begin. x >= 1/2. */
static inline float logarithm(float x)
{
    int32_t e = (bits_of(x) - 0x3f3504f3) >> 23;
    float m = float_of(bits_of(x) - e * (1 << 23));
    float t = (m - 1.f) / (m + 1.f);
    float s = t * t;
    float series = 1.f + s * (1.f / 3 + s * (1.f / 5 + s * (1.f / 7 + s * (1.f / 9))));
    return (float)e * 0.6931471805599453f + 2.f * t * series;
}

static inline float luminance(float red, float green, float blue)
{
    return 0.2126f * red + 0.7152f * green + 0.0722f * blue;
}

static float float_of_half(uint16_t half)
{
    float magnitude = float_of((half & 0x7fff) << 13) * 0x1p112f; /* the bias of exponents differs by 112 */
    return half & 0x8000 ? -magnitude : magnitude;
}

static int rounded_up(int x, int multiple) { return (x + multiple - 1) / multiple * multiple; }

static int blocks_along(int size) { return (size + BLOCK - 1) / BLOCK; }

static int tiles_along(int size) { return (size + TILE - 1) / TILE; }

/* --- State and memory --------------------------------------------------------------------------------------------- */

/* clang-format off */
/* Layers are matrices: their inputs are lines, see multiply. */
typedef enum {
    ENTER_1, ENTER_2, DOWN_B, CONVOLVE_B, DOWN_C, CONVOLVE_C1, CONVOLVE_C2,
    UP_B, JOIN_B, UP_A, JOIN_A, LEAVE, DETAIL_1, DETAIL_2, LAYERS
} LayerName;

enum {
    INPUTS = 5 * RGB + 4 + LATENT + RGB + RGB + 2,
    OUTPUTS = FEATURES + 3 * LEVELS + 2 + LATENT
};

static const int LAYER_SIZES[LAYERS][2] = { /* outputs, inputs */
    [ENTER_1] = {WIDTH_A, PATCH * INPUTS},
    [ENTER_2] = {WIDTH_A, WIDTH_A},
    [DOWN_B] = {WIDTH_B, PATCH * WIDTH_A},
    [CONVOLVE_B] = {WIDTH_B, 9 * WIDTH_B},
    [DOWN_C] = {WIDTH_C, PATCH * WIDTH_B},
    [CONVOLVE_C1] = {WIDTH_C, 9 * WIDTH_C},
    [CONVOLVE_C2] = {WIDTH_C, 9 * WIDTH_C},
    [UP_B] = {PATCH * WIDTH_B, WIDTH_C},
    [JOIN_B] = {WIDTH_B, 9 * WIDTH_B},
    [UP_A] = {PATCH * WIDTH_A, WIDTH_B},
    [JOIN_A] = {WIDTH_A, 9 * WIDTH_A},
    [LEAVE] = {PATCH * OUTPUTS, WIDTH_A},
    [DETAIL_1] = {DETAIL, INPUTS},
    [DETAIL_2] = {OUTPUTS, DETAIL},
};
/* clang-format on */

/* A convolution of 3 x 3 gets two rows from four products of sums of rows, see convolve. */
enum { PRODUCTS = 4, COLUMNS = 3, TAPS = 9 };

static int is_convolution(int name)
{
    return name == CONVOLVE_B || name == CONVOLVE_C1 || name == CONVOLVE_C2 || name == JOIN_B || name == JOIN_A;
}

typedef struct {
    int inputs, outputs;  /* the latter a multiple of AT_ONCE: the last ones may be 0 */
    const float *bias;    /* (outputs) */
    const float *weights; /* (outputs / AT_ONCE, inputs, AT_ONCE); of a convolution, of each product */
} Layer;

/* Lines of a row that are kept for the whole image. */
enum {
    FEATURE_LINES = 0,
    NOISY_LINES = FEATURE_LINES, /* irradiance of the frame, until `leave` */
    LEVEL_LINES = FEATURES, /* of each level: sharpness, centre, importance; later on, the last image but one */
    ALPHA_LINE = LEVEL_LINES + 3 * LEVELS,
    OUTLIER_LINE, /* share of the accumulation that is spread; until `leave` the luminance where outliers begin */
    GUIDE_LINE = OUTLIER_LINE, /* once they are spread */
    OUTPUT_LINES, /* of the previous frame, reprojected */
    ACCUMULATED_LINES = OUTPUT_LINES + RGB,
    LENGTH_LINE = ACCUMULATED_LINES + RGB, /* of the history in samples; until `leave` of the past one, 0 for none */
    LATENT_LINES,
    ROW_LINES = LATENT_LINES + LATENT
};

/* Channels of a texel, in the order of a row's lines from OUTPUT_LINES on, then the normal. */
enum {
    OUTPUT = 0,
    ACCUMULATED = OUTPUT + RGB,
    LENGTH = ACCUMULATED + RGB,
    LATENT_FROM = LENGTH + 1,
    HISTORY = LATENT_FROM + LATENT, /* ONESPP_HISTORY */
    NORMAL = HISTORY,
    TEXEL = 16
};

/* Lines of a row of a part of the light. Passes of the filter write to the last two images in turn. */
enum { PART_OUTPUT = 0, PART_ACCUMULATED = RGB, PART_FILTERED = 2 * RGB, PART_LINES = 4 * RGB, PART_HISTORY = 2 * RGB };

enum { MAX_PART_HISTORY = PART_HISTORY * ONESPP_MAX_PARTS };

/* Channels that are filtered: the image's colours and the sum of its weights, then colours of parts of the light. */
enum { MASS = RGB, FILTERED, MAX_FILTERED = FILTERED + RGB * ONESPP_MAX_PARTS };

/* Taps that the filter measures distances to, in the order of taps. Distances to the others are measured from there. */
enum { RIGHT, LEFT_BELOW, BELOW, RIGHT_BELOW, DIRECTIONS };

/* Some rows of an image at the network's resolutions, surrounded by zeros. */
typedef struct {
    float *data;
    ptrdiff_t pitch; /* floats from line to line */
    int channels;
    int first; /* row of the image that is stored first */
} Window;

/* A mean over frames: even at first, then with weight 1/10 for the newest. */
typedef struct {
    float value;
    int count;
} RunningMean;

/* How the light of a block has changed where it has a history, or what a tile's denoised light lacks: sums over pixels. */
typedef struct {
    float past;             /* luminance of the history, or of the denoised light */
    float change, variance; /* that of the frame less that, and its variance */
    float gain;             /* what the light is multiplied by */
} Change;

/* The residual of a tile: what its samples have more than its denoised light, relative. */
typedef struct {
    float sum, variance; /* over pixels, the mean over frames */
    float length;        /* frames */
} Residual;

/* What one frame adds to it, as sums over pixels, and what it corrects. */
typedef struct {
    float residual, square, light, motion[2], pixels;
    float gain;
} Comparison;

/* How a mesh moves from this frame's camera space to the world's axes around the previous eye. */
typedef struct {
    float to_previous[3][4];
    float turn[3][3]; /* of normals in world space */
} Motion;

enum {
    HALO = 8, /* pixels to the left and right of a chunk; statistics over 9 x 9 pixels need 4 */
    SPAN = CHUNK + 2 * HALO,
    RING = 8, /* rows around the one at work, row y in slot y % RING: from 3 above to 4 below */
    SUMS = 6  /* red, green, blue, luminance, its square, 1 */
};

/* What statistics of a chunk's neighbourhoods are computed from; pixel x of the chunk is at HALO + x. */
typedef struct {
    int first, next; /* rows: the first that was read, and the one that will be */
    int32_t mesh[RING][SPAN];
    float pixels[RING][SUMS][SPAN];
    float sums[RING][SUMS][SPAN]; /* over 3 x 3 pixels */
    float sums_9x9[SUMS][SPAN];
} Neighbourhood;

/* What a convolution works with: pixel x of a chunk is at x + 1 of the sums of rows. */
typedef struct {
    float sums[PRODUCTS][WIDTH_C][HALF_LINE];
    float products[PRODUCTS][WIDTH_C][HALF_LINE];
} Convolution;

/* What each task works with. */
typedef union {
    struct {
        float history[TEXEL][LINE]; /* the last lines are not used */
        float parts[MAX_PART_HISTORY][LINE];
    } past;
    struct {
        Neighbourhood around;
        float most[LINE]; /* luminance of a pixel that is no outlier */
        float lines[2][INPUTS][LINE];
        float patches[PATCH * INPUTS][HALF_LINE];
        float entered[WIDTH_A][HALF_LINE];
    } enter;
    float patches[PATCH * WIDTH_B][HALF_LINE];
    Convolution convolution;
    struct {
        Convolution convolution;
        float joined[2][WIDTH_A][HALF_LINE];
        float patches[PATCH * OUTPUTS][HALF_LINE];
        float head[OUTPUTS + AT_ONCE][LINE];
        float noisy[RGB][LINE];
        float depth[LINE];
    } leave;
} Scratch;

/* The array of all weights, in one of two forms: the other is NULL. */
typedef struct {
    const uint16_t *halves;
    const float *floats;
} Weights;

/* This file, compiled for an instruction set. */
typedef struct {
    int isa;
    uint64_t (*measure)(const onespp_config *config); /* bytes of memory */
    onespp *(*create)(const onespp_config *config, void *memory, const Weights *weights);
    int (*denoise)(
        onespp *d, void *past, void *next, const onespp_frame *frame, const onespp_output *radiance);
} Engine;

/* What a frame leaves to the next one, but for arrays. */
typedef struct {
    int width, height; /* 0 before the first frame */
    int meshes, parts;
    RunningMean log_luminance, log_depth;
    double K[9], camera_to_world[16];
} Moment;

/* Where all that a frame leaves is, in memory that may be copied elsewhere. */
typedef struct {
    Moment *moment;
    double *object_to_world;
    float *texels;
    float *part_texels; /* PART_HISTORY of each part */
    float *depth;
    int32_t *mesh;
    Residual *residuals; /* of tiles */
} History;

struct onespp {
    const Engine *engine; /* set by the interface */
    onespp_config config;
    Layer layers[LAYERS];
    void *own_history;  /* of onespp_denoise */
    History past, next; /* of the frame at work; maybe the same */

    /* What a frame needs. */
    ptrdiff_t pitch; /* of lines of rows, and of depth and mesh */
    float *rows, *part_rows;
    Window a, b, b_too, c, c_too; /* activations at 1/2, 1/4 and 1/8 of the resolution, of a strip */
    Window sum_a;                 /* of `a` and what comes from 1/4 */
    Window hidden;                /* of the per-pixel layers */
    float *zeros, *ones;          /* lines */
    Motion *motions;
    double *blocks; /* mean luminance of each, -1 without surfaces */
    Change *changes; /* of the blocks' light */
    Change *row_changes; /* the same, summed along rows */
    Change *tiles, *row_tiles; /* the same of tiles' residuals */
    Comparison *comparisons; /* of tiles */
    Residual *residuals;
    float *depths;
    float *distances; /* lines of each task, see distance_line */
    Scratch *scratch;
    float *parameters;
};

typedef struct {
    unsigned char *base; /* NULL to measure */
    uint64_t used;
} Arena;

static void *allocate(Arena *arena, uint64_t count, size_t size)
{
    void *memory = arena->base ? arena->base + arena->used : NULL;
    arena->used += (count * size + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
    return memory;
}

static ptrdiff_t pitch_of(const onespp_config *config) { return PITCH(MARGIN + config->max_width + MARGIN); }

/* Floats of the lines that distance_line returns. */
static uint64_t count_distances(const onespp_config *config)
{
    return 2 * DIRECTIONS * (uint64_t)config->tasks * (uint64_t)pitch_of(config);
}

/* How many squares of that side an image has at most. */
static uint64_t count_squares(const onespp_config *config, int side)
{
    return (uint64_t)((config->max_width + side - 1) / side) * (uint64_t)((config->max_height + side - 1) / side);
}

static History lay_out_history(const onespp_config *config, Arena *arena)
{
    uint64_t pixels = (uint64_t)config->max_height * (uint64_t)pitch_of(config);
    History history;
    history.moment = allocate(arena, 1, sizeof(Moment));
    history.texels = allocate(arena, pixels * TEXEL, sizeof(float));
    history.part_texels = allocate(arena, pixels * PART_HISTORY * (uint64_t)config->max_parts, sizeof(float));
    history.depth = allocate(arena, pixels, sizeof(float));
    history.mesh = allocate(arena, pixels, sizeof(int32_t));
    history.residuals = allocate(arena, count_squares(config, TILE), sizeof(Residual));
    history.object_to_world = allocate(arena, (uint64_t)config->max_meshes * 16, sizeof(double)); /* may be longer */
    return history;
}

static uint64_t measure_history(const onespp_config *config)
{
    Arena arena = {NULL, 0};
    lay_out_history(config, &arena);
    return arena.used;
}

static Window window(Arena *arena, int channels, int width, int rows)
{
    Window w = {NULL, PITCH(PAD + rounded_up(width, LANES) + 1), channels, 0};
    w.data = allocate(arena, (uint64_t)rows * (uint64_t)channels * (uint64_t)w.pitch, sizeof(float));
    return w;
}

/* A strip's height in rows of 1/8 of the resolution. */
static int strip_height(const onespp_config *config)
{
    int rows = maxi(MIN_STRIP_ROWS, ONESPP_STRIP_PIXELS / config->max_width) / 8;
    return mini(rows, rounded_up(config->max_height, 8) / 8);
}

static void lay_out_strip(onespp *d, Arena *arena)
{
    int width = rounded_up(d->config.max_width, 8);
    int rows = strip_height(&d->config);
    d->a = window(arena, WIDTH_A, width / 2, 4 * rows + 2 * REACH_A);
    d->hidden = window(arena, DETAIL, width, 8 * rows + 2 * REACH_A);
    d->b = window(arena, WIDTH_B, width / 4, 2 * rows + 4 * REACH_C + 2);
    d->b_too = window(arena, WIDTH_B, width / 4, 2 * rows + 4 * REACH_C + 2);
    d->c = window(arena, WIDTH_C, width / 8, rows + 2 * REACH_C);
    d->c_too = window(arena, WIDTH_C, width / 8, rows + 2 * REACH_C);
    d->sum_a = window(arena, WIDTH_A, width / 2, 4 * rows + 4);
    d->zeros = allocate(arena, (uint64_t)d->a.pitch, sizeof(float));
    d->ones = allocate(arena, (uint64_t)d->pitch, sizeof(float));
}

/* How many floats a layer's bias and weights are. */
static uint64_t parameters_of(const Layer *layer, int name)
{
    return (uint64_t)(layer->outputs * (layer->inputs * (is_convolution(name) ? PRODUCTS : 1) + 1));
}

static void lay_out_layers(onespp *d, Arena *arena)
{
    uint64_t count = 0;
    for (int i = 0; i < LAYERS; i++) {
        Layer *layer = &d->layers[i];
        layer->outputs = rounded_up(LAYER_SIZES[i][0], AT_ONCE);
        layer->inputs = LAYER_SIZES[i][1];
        if (is_convolution(i))
            layer->inputs = layer->inputs / TAPS * COLUMNS;
        count += parameters_of(layer, i);
    }
    d->parameters = allocate(arena, count, sizeof(float));
}

/* Where everything is in memory. */
static void lay_out(onespp *d, Arena *arena)
{
    uint64_t height = (uint64_t)d->config.max_height;
    uint64_t blocks = count_squares(&d->config, BLOCK), tiles = count_squares(&d->config, TILE);
    d->pitch = pitch_of(&d->config);
    uint64_t pixels = height * (uint64_t)d->pitch;
    d->own_history = allocate(arena, 1, measure_history(&d->config));
    d->rows = allocate(arena, pixels * ROW_LINES, sizeof(float));
    d->part_rows = allocate(arena, pixels * PART_LINES * (uint64_t)d->config.max_parts, sizeof(float));
    d->motions = allocate(arena, (uint64_t)d->config.max_meshes + 1, sizeof(Motion));
    d->blocks = allocate(arena, blocks, sizeof(double));
    d->changes = allocate(arena, blocks, sizeof(Change));
    d->row_changes = allocate(arena, blocks, sizeof(Change));
    d->tiles = allocate(arena, tiles, sizeof(Change));
    d->row_tiles = allocate(arena, tiles, sizeof(Change));
    d->comparisons = allocate(arena, tiles, sizeof(Comparison));
    d->residuals = allocate(arena, tiles, sizeof(Residual));
    d->depths = allocate(arena, MAX_DEPTHS, sizeof(float));
    d->distances = allocate(arena, count_distances(&d->config), sizeof(float));
    d->scratch = allocate(arena, (uint64_t)d->config.tasks, sizeof(Scratch));
    lay_out_layers(d, arena);
    lay_out_strip(d, arena);
}

/* Where the weight of an input for an output is. */
static ptrdiff_t weight_index(const Layer *layer, int input, int output)
{
    return ((ptrdiff_t)(output / AT_ONCE) * layer->inputs + input) * AT_ONCE + output % AT_ONCE;
}

static float weight_at(const Weights *weights, ptrdiff_t index)
{
    return weights->halves ? float_of_half(weights->halves[index]) : weights->floats[index];
}

/* The weights of a convolution's products, from those of three rows, `row` numbers apart: see convolve. */
static void unpack_column(
    const Layer *layer, float *weights, int input, int outputs, const Weights *all, ptrdiff_t from)
{
    ptrdiff_t size = (ptrdiff_t)layer->outputs * layer->inputs, row = COLUMNS * outputs;
    for (int o = 0; o < outputs; o++, from++) {
        float *to = weights + weight_index(layer, input, o);
        float above = weight_at(all, from), here = weight_at(all, from + row), below = weight_at(all, from + 2 * row);
        to[0] = above;
        to[size] = (above + here + below) / 2;
        to[2 * size] = (above - here + below) / 2;
        to[3 * size] = below;
    }
}

/* Reads a layer from index `from` on: biases, then a matrix (inputs, outputs), where those of a convolution are in the
 * order of channels, rows, columns. Returns the index of what follows it. */
static ptrdiff_t unpack(Layer *layer, int name, float *to, const Weights *all, ptrdiff_t from)
{
    int outputs = LAYER_SIZES[name][0], inputs = LAYER_SIZES[name][1];
    float *weights = to + layer->outputs;
    memset(to, 0, sizeof(float) * (size_t)parameters_of(layer, name));
    for (int o = 0; o < outputs; o++)
        to[o] = weight_at(all, from++);
    for (int i = 0; i < layer->inputs; i++)
        if (is_convolution(name))
            unpack_column(layer, weights, i, outputs, all, from + (i / COLUMNS * TAPS + i % COLUMNS) * outputs);
        else
            for (int o = 0; o < outputs; o++)
                weights[weight_index(layer, i, o)] = weight_at(all, from + i * outputs + o);
    layer->bias = to;
    layer->weights = weights;
    return from + (ptrdiff_t)inputs * outputs;
}

/* --- Frames ------------------------------------------------------------------------------------------------------- */

/* One frame at work. */
typedef struct Job Job;
struct Job {
    onespp *d;
    onespp_frame frame; /* whose optional images are there */
    onespp_output radiance;
    int padded_width, padded_height; /* to whole pixels of 1/8 of the resolution */
    int has_history;
    float exposure, depth_scale;
    float to_view[3][3];        /* of normals in world space: x right, y up, z towards the viewer */
    float slopes[2], origin[2]; /* of this frame's rays in x and in y: (slope * position + origin, 1) */
    float axes[3][3];           /* the previous frame's rays in the world: x axes[0] + y axes[1] + axes[2] */

    void (*work)(Job *job, Scratch *scratch, int first, int last); /* the step at work, on rows first to last - 1 */
    int first, last;
    LayerName layer;
    const Window *from, *skip, *to;
    int pass; /* of the filter */
};

static void run_task(void *argument, int index)
{
    Job *job = argument;
    int64_t rows = job->last - job->first, tasks = job->d->config.tasks;
    int first = job->first + (int)(rows * index / tasks);
    int last = job->first + (int)(rows * (index + 1) / tasks);
    if (first < last)
        job->work(job, &job->d->scratch[index], first, last);
}

/* Does `work` on rows first to last - 1. What is computed for a row must not depend on where tasks begin. */
static void run(Job *job, void (*work)(Job *, Scratch *, int, int), int first, int last)
{
    const onespp_config *config = &job->d->config;
    job->work = work;
    job->first = first;
    job->last = last;
    if (config->parallel_for)
        config->parallel_for(config->user, config->tasks, run_task, job);
    else
        for (int i = 0; i < config->tasks; i++)
            run_task(job, i);
}

/* n pixels of a row of an image, from x on. Not inlined: its many copies would double the time that `make` takes. */
NOINLINE static void load(float *restrict line, const onespp_image *image, int channel, int y, int x, int n)
{
    ptrdiff_t step = image->column;
    const float *from = image->data + image->channel * channel + image->row * y + step * x;
    float constant = finite_or_0(*from);
    for (int i = 0; i < n; i++)
        line[i] = step ? finite_or_0(from[i * step]) : constant;
}

/* Mesh ids of n pixels; negative ones, which stand for pixels outside the image here, count as one mesh. */
static void load_mesh(int32_t *restrict line, const onespp_frame *frame, int y, int x, int n)
{
    if (!frame->mesh_id.data) {
        float depth[SPAN];
        load(depth, &frame->depth, 0, y, x, n);
        for (int i = 0; i < n; i++)
            line[i] = depth[i] > 0;
        return;
    }
    ptrdiff_t step = frame->mesh_id.column;
    const int32_t *from = frame->mesh_id.data + frame->mesh_id.row * y + step * x;
    for (int i = 0; i < n; i++)
        line[i] = from[i * step] < 0 ? INT32_MAX : from[i * step];
}

/* What irradiance is multiplied by: max(albedo, 0.01). */
static void load_divisor(float *restrict line, const onespp_frame *frame, int channel, int y, int x, int n)
{
    load(line, &frame->albedo, channel, y, x, n);
    for (int i = 0; i < n; i++)
        line[i] = minf(maxf(line[i], ALBEDO_FLOOR), MAX_REFLECTANCE);
}

/* A component of n normals, clamped. */
static void load_normal(float *restrict line, const onespp_frame *frame, int component, int y, int x, int n)
{
    load(line, &frame->normal, component, y, x, n);
    for (int i = 0; i < n; i++)
        line[i] = clamped(line[i], MAX_REFLECTANCE);
}

/* Noisy irradiance of one colour of n <= SPAN pixels, 0 for those that show no surface. */
static void load_irradiance(float *restrict line, const onespp_frame *frame, int channel, int y, int x, int n)
{
    float indirect[SPAN], divisor[SPAN], depth[SPAN];
    load(line, &frame->direct, channel, y, x, n);
    load(indirect, &frame->indirect, channel, y, x, n);
    load_divisor(divisor, frame, channel, y, x, n);
    load(depth, &frame->depth, 0, y, x, n);
    for (int i = 0; i < n; i++) {
        float irradiance = minf(maxf((line[i] + indirect[i]) / divisor[i], 0), MAX_IRRADIANCE);
        line[i] = depth[i] > 0 ? irradiance : 0;
    }
}

/* Noisy irradiance of one colour of a part of the light, cut by as much as that of the whole. */
static void load_part(float *restrict line, const onespp_frame *frame, int part, int channel, int y, int x, int n)
{
    float direct[LINE], indirect[LINE], divisor[LINE], depth[LINE];
    load(line, &frame->part[part].noisy, channel, y, x, n);
    load(direct, &frame->direct, channel, y, x, n);
    load(indirect, &frame->indirect, channel, y, x, n);
    load_divisor(divisor, frame, channel, y, x, n);
    load(depth, &frame->depth, 0, y, x, n);
    for (int i = 0; i < n; i++) {
        float whole = (direct[i] + indirect[i]) / divisor[i], kept = maxf(clamped(whole, MAX_IRRADIANCE), 0);
        float share = whole == kept ? 1 : kept / whole;
        line[i] = depth[i] > 0 ? clamped(line[i] * share / divisor[i], MAX_PART) : 0;
    }
}

/* Where a row's mesh ids begin in a history. */
static int32_t *mesh_line(const onespp *d, const History *history, int y)
{
    return history->mesh + (ptrdiff_t)y * d->pitch + MARGIN;
}

/* Where a row's line begins. */
static float *row_line(const onespp *d, int y, int line)
{
    return d->rows + ((ptrdiff_t)y * ROW_LINES + line) * d->pitch + MARGIN;
}

/* The same of a part of the light. */
static float *part_line(const onespp *d, int y, int part, int line)
{
    return d->part_rows + (((ptrdiff_t)y * d->config.max_parts + part) * PART_LINES + line) * d->pitch + MARGIN;
}

/* --- Scale: the exposure and the unit of length that the network sees --------------------------------------------- */

/* Keeps the noisy irradiance of n pixels of a row; adds luminance to the sums of the blocks that they lie in, and counts
 * surfaces. */
static void measure_row(const Job *job, int y, int x0, int n, float *restrict sums, int *restrict surfaces)
{
    float light[RGB][LINE], divisor[LINE], depth[LINE];
    for (int c = 0; c < RGB; c++) {
        float *restrict noisy = row_line(job->d, y, NOISY_LINES + c) + x0;
        load_irradiance(noisy, &job->frame, c, y, x0, n);
        load_divisor(divisor, &job->frame, c, y, x0, n);
        for (int i = 0; i < n; i++)
            light[c][i] = noisy[i] * divisor[i];
    }
    load(depth, &job->frame.depth, 0, y, x0, n);
    for (int i = 0; i < n; i++) {
        sums[i / BLOCK] += luminance(light[0][i], light[1][i], light[2][i]);
        surfaces[i / BLOCK] += depth[i] > 0;
    }
}

/* Mean luminance of the surfaces of blocks, -1 without any. The rows are those of blocks. */
static void measure_rows(Job *job, Scratch *scratch, int first, int last)
{
    (void)scratch;
    const onespp_frame *frame = &job->frame;
    int columns = blocks_along(frame->width);
    for (int row = first; row < last; row++)
        for (int x0 = 0; x0 < frame->width; x0 += CHUNK) {
            float sums[CHUNK / BLOCK] = {0};
            int surfaces[CHUNK / BLOCK] = {0}, n = mini(CHUNK, frame->width - x0);
            for (int y = row * BLOCK; y < mini((row + 1) * BLOCK, frame->height); y++)
                measure_row(job, y, x0, n, sums, surfaces);
            double *means = job->d->blocks + (ptrdiff_t)row * columns + x0 / BLOCK;
            for (int i = 0; i * BLOCK < n; i++)
                means[i] = surfaces[i] ? (double)sums[i] / surfaces[i] : -1;
        }
}

static void update(RunningMean *mean, double value)
{
    if (!isfinite(value))
        return;
    mean->count = mini(mean->count + 1, 10);
    mean->value += ((float)value - mean->value) / (float)mean->count;
}

/* The mean over blocks of ln luminance; not finite where all is black. */
static double log_luminance(const double *blocks, int count)
{
    double mean = 0, sum = 0;
    int surfaces = 0;
    for (int i = 0; i < count; i++) {
        surfaces += blocks[i] >= 0;
        mean += fmax(blocks[i], 0);
    }
    mean /= surfaces;
    for (int i = 0; i < count; i++)
        if (blocks[i] >= 0)
            sum += log(fmax(blocks[i], 1e-4 * mean));
    return surfaces ? sum / surfaces : NAN;
}

/* The lower median of positive numbers, whose bits are in the same order as they: bit by bit from the highest. */
static float median(const float *numbers, int count)
{
    int32_t found = 0;
    for (int32_t bit = 1 << 30; bit; bit >>= 1) {
        int below = 0;
        for (int i = 0; i < count; i++)
            below += bits_of(numbers[i]) < (found | bit);
        if (below <= (count - 1) / 2)
            found |= bit;
    }
    return float_of(found);
}

/* ln of the median depth of surfaces; not finite without any. */
static double log_depth(const onespp *d, const onespp_frame *frame)
{
    int step_y = maxi(1, frame->height / MEDIAN_GRID), step_x = maxi(1, frame->width / MEDIAN_GRID);
    int count = 0;
    for (int y = 0; y < frame->height; y += step_y)
        for (int x = 0; x < frame->width; x += step_x) {
            load(&d->depths[count], &frame->depth, 0, y, x, 1);
            count += d->depths[count] > 0;
        }
    return count ? log((double)median(d->depths, count)) : NAN;
}

/* The exposure and the unit of length, from means over all frames of the sequence: both begin anew without history. */
static void measure(Job *job)
{
    onespp *d = job->d;
    Moment *next = d->next.moment;
    RunningMean no_luminance = {logf(MIDDLE_GREY), 0}, no_depth = {0, 0};
    int columns = blocks_along(job->frame.width), rows = blocks_along(job->frame.height);
    run(job, measure_rows, 0, rows);
    next->log_luminance = job->has_history ? d->past.moment->log_luminance : no_luminance;
    next->log_depth = job->has_history ? d->past.moment->log_depth : no_depth;
    update(&next->log_luminance, log_luminance(d->blocks, columns * rows));
    update(&next->log_depth, log_depth(d, &job->frame));
    job->exposure = clamped(MIDDLE_GREY * expf(-next->log_luminance.value), MAX_MAGNITUDE);
    job->depth_scale = clamped(expf(next->log_depth.value), MAX_MAGNITUDE);
}

/* --- Geometry ----------------------------------------------------------------------------------------------------- */

/* out = a b, of rigid transforms. */
static void multiply_poses(double out[16], const double a[16], const double b[16])
{
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++) {
            double sum = 0;
            for (int k = 0; k < 4; k++)
                sum += a[4 * i + k] * b[4 * k + j];
            out[4 * i + j] = sum;
        }
}

static void invert_pose(double out[16], const double pose[16])
{
    for (int i = 0; i < 3; i++) {
        out[4 * i + 3] = 0;
        for (int j = 0; j < 3; j++) {
            out[4 * i + j] = pose[4 * j + i];
            out[4 * i + 3] -= pose[4 * j + i] * pose[4 * j + 3];
        }
    }
    for (int j = 0; j < 4; j++)
        out[12 + j] = j == 3;
}

/* The motion of a mesh whose pose goes from `before` to `now`, or of what stands still where these are NULL. Products
 * are in double, and the eye is subtracted before rounding: scenes far from the origin keep their precision. */
static Motion motion_of(const Job *job, const double *before, const double *now)
{
    const double *pose = job->frame.camera_to_world, *eye = job->d->past.moment->camera_to_world;
    double moved[16];
    Motion motion;
    memcpy(moved, pose, sizeof moved);
    if (now) {
        double to_rest[16], at_rest[16];
        invert_pose(to_rest, now);
        multiply_poses(at_rest, to_rest, pose);
        multiply_poses(moved, before, at_rest);
    }
    for (int i = 0; i < 3; i++) {
        const double *row = moved + 4 * i;
        for (int j = 0; j < 3; j++) {
            const double *axis = pose + 4 * j;
            motion.to_previous[i][j] = (float)row[j];
            motion.turn[i][j] = (float)(row[0] * axis[0] + row[1] * axis[1] + row[2] * axis[2]);
        }
        motion.to_previous[i][3] = (float)(row[3] - eye[4 * i + 3]);
    }
    return motion;
}

static void set_up_geometry(Job *job)
{
    onespp *d = job->d;
    const onespp_frame *frame = &job->frame;
    const double *pose = frame->camera_to_world;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            job->to_view[i][j] = (float)(i == 1 ? pose[4 * j + i] : -pose[4 * j + i]);
    if (!job->has_history)
        return;
    const Moment *past = d->past.moment;
    const double *eye = past->camera_to_world;
    for (int i = 0; i < 2; i++) {
        job->slopes[i] = (float)(1 / frame->K[4 * i]);
        job->origin[i] = (float)(-frame->K[3 * i + 2] / frame->K[4 * i]);
    }
    for (int i = 0; i < 3; i++) {
        double x = eye[4 * i] / past->K[0], y = eye[4 * i + 1] / past->K[4];
        job->axes[0][i] = (float)x;
        job->axes[1][i] = (float)y;
        job->axes[2][i] = (float)(eye[4 * i + 2] - x * past->K[2] - y * past->K[5]);
    }
    d->motions[0] = motion_of(job, NULL, NULL);
    for (int i = 0; i < frame->meshes; i++) {
        const double *before = i < past->meshes ? d->past.object_to_world + 16 * i : NULL; /* new meshes stand still */
        d->motions[i + 1] = motion_of(job, before, before ? frame->object_to_world + 16 * i : NULL);
    }
}

/* --- Interleaving ------------------------------------------------------------------------------------------------- */

/* Even and odd pixels of 2 n pixels. */
static void split(float *restrict even, float *restrict odd, const float *restrict line, int n)
{
    for (int i = 0; i < n; i++) {
        even[i] = line[2 * i];
        odd[i] = line[2 * i + 1];
    }
}

static void join(float *restrict line, const float *restrict even, const float *restrict odd, int n)
{
    for (int i = 0; i < n; i++) {
        line[2 * i] = even[i];
        line[2 * i + 1] = odd[i];
    }
}

/* Texels of n pixels from the lines of their channels, a transposition that compilers vectorise: each round joins a line
 * of the first half of them with one of the second half. */
static void join_texels(float *restrict texels, const float *const lines[TEXEL], int n)
{
    float two[TEXEL / 2][2 * CHUNK], four[TEXEL / 4][4 * CHUNK];
    for (int c = 0; c < 8; c++)
        join(two[c], lines[c], lines[c + 8], n);
    for (int c = 0; c < 4; c++)
        join(four[c], two[c], two[c + 4], 2 * n);
    for (int c = 0; c < 2; c++)
        join(two[4 * c], four[c], four[c + 2], 4 * n);
    join(texels, two[0], two[4], 8 * n);
}

/* The rounds of join_texels, undone. */
static void split_texels(float (*restrict lines)[LINE], const float *restrict texels, int n)
{
    float two[TEXEL / 2][2 * CHUNK], four[TEXEL / 4][4 * CHUNK];
    split(two[0], two[4], texels, 8 * n);
    for (int c = 0; c < 2; c++)
        split(four[c], four[c + 2], two[4 * c], 4 * n);
    for (int c = 0; c < 4; c++)
        split(two[c], two[c + 4], four[c], 2 * n);
    for (int c = 0; c < 8; c++)
        split(lines[c], lines[c + 8], two[c], n);
}

/* --- Reprojection: what the previous frame holds of a pixel's surface --------------------------------------------- */

typedef struct {
    float point[3], normal[3]; /* where the surface was, in the world's axes around the previous eye, and its normal */
    int32_t mesh;
} Surface;

static Surface surface_before(const Job *job, int x, int y, float depth, const float normal[3], int32_t mesh)
{
    Surface surface;
    const Motion *motion = &job->d->motions[mesh <= job->frame.meshes ? mesh : BACKGROUND];
    float px = (job->slopes[0] * ((float)x + 0.5f) + job->origin[0]) * depth;
    float py = (job->slopes[1] * ((float)y + 0.5f) + job->origin[1]) * depth;
    for (int i = 0; i < 3; i++) {
        const float *row = motion->to_previous[i], *turn = motion->turn[i];
        surface.point[i] = row[0] * px + row[1] * py + row[2] * depth + row[3];
        surface.normal[i] = turn[0] * normal[0] + turn[1] * normal[1] + turn[2] * normal[2];
    }
    surface.mesh = mesh;
    return surface;
}

/* Whether pixel (x, y) of the previous frame shows the surface. */
static inline int is_consistent(const Job *job, const Surface *surface, int x, int y)
{
    const History *past = &job->d->past;
    ptrdiff_t pixel = (ptrdiff_t)y * job->d->pitch + x;
    if (x < 0 || y < 0 || x >= past->moment->width || y >= past->moment->height)
        return 0;
    if (mesh_line(job->d, past, y)[x] != surface->mesh)
        return 0;
    if (surface->mesh == BACKGROUND)
        return 1;
    const float *normal = past->texels + pixel * TEXEL + NORMAL;
    float px = (float)x + 0.5f, py = (float)y + 0.5f;
    float depth = past->depth[pixel], off_plane = 0, cosine = 0;
    for (int i = 0; i < 3; i++) {
        float visible = depth * (job->axes[0][i] * px + job->axes[1][i] * py + job->axes[2][i]);
        off_plane += (surface->point[i] - visible) * normal[i];
        cosine += normal[i] * surface->normal[i];
    }
    return fabsf(off_plane) <= PLANE_TOLERANCE * depth && cosine >= NORMAL_TOLERANCE;
}

static inline void add_texel(
    float *restrict sum, float *restrict of_part, float weight, const Job *job, int x, int y)
{
    ptrdiff_t pixel = (ptrdiff_t)y * job->d->pitch + x;
    int of_parts = PART_HISTORY * job->frame.parts;
    const float *restrict texel = job->d->past.texels + pixel * TEXEL;
    const float *restrict parts = job->d->past.part_texels + pixel * of_parts;
    for (int c = 0; c < TEXEL; c++)
        sum[c] += weight * texel[c];
    for (int c = 0; c < of_parts; c++)
        of_part[c] += weight * parts[c];
}

/* The mean of the consistent ones among 3 x 3 pixels. */
static void fetch_box(const Job *job, const Surface *surface, int x, int y, float *texel, float *of_part)
{
    int count = 0;
    for (int tap = 0; tap < 9; tap++) {
        int column = x + tap % 3 - 1, row = y + tap / 3 - 1;
        if (is_consistent(job, surface, column, row)) {
            add_texel(texel, of_part, 1, job, column, row);
            count++;
        }
    }
    for (int c = 0; c < TEXEL; c++)
        texel[c] /= (float)maxi(count, 1);
    for (int c = 0; c < PART_HISTORY * job->frame.parts; c++)
        of_part[c] /= (float)maxi(count, 1);
}

/* The history of a surface at position (x, y) of the previous frame, from the corners of pixels, added to a texel of 0
 * and those of parts: nothing where there is none.
 *
 * The weights of taps that fail are spread evenly over the others (SVGF, section 4.1). */
static void fetch(const Job *job, const Surface *surface, float x, float y, float *texel, float *of_part)
{
    int left = (int)floorf(x), top = (int)floorf(y);
    float fx = x - (float)left, fy = y - (float)top;
    float weights[4] = {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
    int good[4], count = 0;
    float failed = 0;
    for (int tap = 0; tap < 4; tap++) {
        good[tap] = is_consistent(job, surface, left + tap % 2, top + tap / 2);
        count += good[tap];
        failed += good[tap] ? 0 : weights[tap];
    }
    if (count == 0) {
        fetch_box(job, surface, left + (fx >= 0.5f), top + (fy >= 0.5f), texel, of_part);
        return;
    }
    for (int tap = 0; tap < 4; tap++)
        if (good[tap])
            add_texel(texel, of_part, weights[tap] + failed / (float)count, job, left + tap % 2, top + tap / 2);
}

/* The history of n pixels of a row, from x0 on; 0 where there is none. */
static void reproject(
    const Job *job, int y, int x0, int n, float (*restrict history)[LINE], float (*restrict parts)[LINE])
{
    float motion[2][LINE], depth[LINE], normal[3][LINE], texels[CHUNK][TEXEL], of_part[MAX_PART_HISTORY];
    int32_t mesh[LINE];
    int of_parts = PART_HISTORY * job->frame.parts;
    if (!job->has_history) {
        memset(history, 0, sizeof *history * HISTORY);
        memset(parts, 0, sizeof *parts * (size_t)of_parts);
        return;
    }
    for (int c = 0; c < 2; c++)
        load(motion[c], &job->frame.motion, c, y, x0, n);
    for (int c = 0; c < 3; c++)
        load_normal(normal[c], &job->frame, c, y, x0, n);
    load(depth, &job->frame.depth, 0, y, x0, n);
    load_mesh(mesh, &job->frame, y, x0, n);
    memset(texels, 0, sizeof texels);
    for (int i = 0; i < n; i++) {
        memset(of_part, 0, sizeof(float) * (size_t)of_parts);
        if (depth[i] > 0) {
            /* Far outside the image an index would overflow; any place outside is as good. */
            float x = maxf(minf((float)(x0 + i) + motion[0][i], (float)job->frame.width + 1), -2);
            float y_then = maxf(minf((float)y + motion[1][i], (float)job->frame.height + 1), -2);
            float n_here[3] = {normal[0][i], normal[1][i], normal[2][i]};
            Surface surface = surface_before(job, x0 + i, y, depth[i], n_here, mesh[i]);
            fetch(job, &surface, x, y_then, texels[i], of_part);
        }
        for (int c = 0; c < of_parts; c++)
            parts[c][i] = of_part[c];
    }
    split_texels(history, texels[0], n);
}

/* --- Changes of light: the history follows them ------------------------------------------------------------------- */

/* Adds n pixels of a row, from the first of a block on, to the changes of the blocks that they lie in. */
static void add_change(const Job *job, int y, int x0, int n, Change *changes)
{
    const onespp *d = job->d;
    const float *noisy = row_line(d, y, NOISY_LINES) + x0, *output = row_line(d, y, OUTPUT_LINES) + x0;
    const float *length = row_line(d, y, LENGTH_LINE) + x0;
    float past[LINE], change[LINE];
    for (int i = 0; i < n; i++) {
        float now = luminance(noisy[i], noisy[d->pitch + i], noisy[2 * d->pitch + i]);
        float before = minf(luminance(output[i], output[d->pitch + i], output[2 * d->pitch + i]), MAX_LUMINANCE);
        past[i] = length[i] > 0 ? before : 0;
        change[i] = length[i] > 0 ? minf(now, MAX_LUMINANCE) - before : 0;
    }
    for (int i = 0; i < n; i++) {
        Change *block = changes + i / BLOCK;
        block->past += past[i];
        block->change += change[i];
        block->variance += change[i] * change[i];
    }
}

/* Keeps the reprojected history of n pixels of a row. */
static void keep_history(const Job *job, Scratch *scratch, int y, int x0, int n)
{
    float(*history)[LINE] = scratch->past.history, (*parts)[LINE] = scratch->past.parts;
    reproject(job, y, x0, n, history, parts);
    for (int c = 0; c < HISTORY; c++)
        memcpy(row_line(job->d, y, OUTPUT_LINES + c) + x0, history[c], sizeof(float) * (size_t)n);
    for (int c = 0; c < PART_HISTORY * job->frame.parts; c++)
        memcpy(part_line(job->d, y, c / PART_HISTORY, c % PART_HISTORY) + x0, parts[c], sizeof(float) * (size_t)n);
}

/* The rows are those of blocks. */
static void reproject_rows(Job *job, Scratch *scratch, int first, int last)
{
    int columns = blocks_along(job->frame.width);
    for (int row = first; row < last; row++) {
        Change *changes = job->d->changes + (ptrdiff_t)row * columns;
        memset(changes, 0, sizeof *changes * (size_t)columns);
        for (int y = row * BLOCK; y < mini((row + 1) * BLOCK, job->frame.height); y++)
            for (int x0 = 0; x0 < job->frame.width; x0 += CHUNK) {
                int n = mini(CHUNK, job->frame.width - x0);
                keep_history(job, scratch, y, x0, n);
                add_change(job, y, x0, n, changes + x0 / BLOCK);
            }
    }
}

/* The weighted sum of changes up to `radius` around the one at `index` of `count`, `step` apart. */
static Change sum_around(
    const Change *changes, int index, int count, ptrdiff_t step, const float *weights, int radius)
{
    Change sum = {0, 0, 0, 1};
    for (int tap = maxi(0, radius - index); tap < mini(2 * radius + 1, count - index + radius); tap++) {
        const Change *there = changes + (index + tap - radius) * step;
        sum.past += weights[tap] * there->past;
        sum.change += weights[tap] * there->change;
        sum.variance += weights[tap] * there->variance;
    }
    return sum;
}

/* What light is multiplied by where its surroundings have changed: the ratio, from `least` to MAX_GAIN, shrunk by the
 * noise of the change, which counts from so many standard errors on. The squared standard error of a sum with weights w is
 * that of w^2 v for values of variance v, for a Gaussian w half that of w v. */
static float gain_of(const Change *around, float errors, float least)
{
    float size = maxf(fabsf(around->change), MIN_CHANGE);
    float noise = errors * errors / 2 * around->variance / size / size;
    float relative = maxf(minf(around->change / maxf(around->past, MIN_CHANGE), MAX_GAIN - 1), least - 1);
    return 1 + maxf(1 - noise, 0) * relative;
}

/* The gain of each of rows * columns squares; `sums` has room for as many. */
static void find_gains(
    Change *changes, Change *sums, int rows, int columns, int deviation, float errors, float least)
{
    float weights[MAX_GAUSSIAN];
    int radius = REACH * deviation;
    for (int i = 0; i < 2 * radius + 1; i++) {
        float distance = (float)(i - radius) / (float)deviation;
        weights[i] = expf(-distance * distance / 2);
    }
    for (int i = 0; i < rows * columns; i++)
        sums[i] = sum_around(changes + i / columns * columns, i % columns, columns, 1, weights, radius);
    for (int i = 0; i < rows * columns; i++) {
        Change around = sum_around(sums + i % columns, i / columns, rows, columns, weights, radius);
        changes[i].gain = gain_of(&around, errors, least);
    }
}

/* Where a pixel lies between the centres of squares: the one before it, and how far it is to the next. */
static float between(int pixel, int side, int *before)
{
    float place = maxf(((float)pixel + 0.5f) / (float)side - 0.5f, 0);
    *before = (int)place;
    return place - (float)*before;
}

/* The gain of n pixels of a row, interpolated between squares of that side. */
static void interpolate_gain(
    float *restrict gain, const Job *job, const Change *changes, int side, int y, int x0, int n)
{
    int columns = (job->frame.width + side - 1) / side, rows = (job->frame.height + side - 1) / side, above, left;
    float down = between(y, side, &above);
    const Change *upper = changes + (ptrdiff_t)above * columns;
    const Change *lower = changes + (ptrdiff_t)mini(above + 1, rows - 1) * columns;
    for (int i = 0; i < n; i++) {
        float across = between(x0 + i, side, &left);
        int right = mini(left + 1, columns - 1);
        float first = upper[left].gain + down * (lower[left].gain - upper[left].gain);
        float second = upper[right].gain + down * (lower[right].gain - upper[right].gain);
        gain[i] = first + across * (second - first);
    }
}

/* Multiplies the light in the history of n pixels of a row by the gain of blocks. */
static void follow_light(const Job *job, int y, int x0, int n)
{
    const onespp *d = job->d;
    float gain[LINE];
    interpolate_gain(gain, job, d->changes, BLOCK, y, x0, n);
    for (int c = OUTPUT; c < LENGTH; c++) {
        float *restrict line = row_line(d, y, OUTPUT_LINES + c) + x0;
        for (int i = 0; i < n; i++)
            line[i] *= gain[i];
    }
    for (int c = 0; c < PART_HISTORY * (job->frame.parts - job->frame.masks); c++) {
        float *restrict line = part_line(d, y, c / PART_HISTORY, c % PART_HISTORY) + x0;
        for (int i = 0; i < n; i++)
            line[i] *= gain[i];
    }
}

static void follow_rows(Job *job, Scratch *scratch, int first, int last)
{
    (void)scratch;
    for (int y = first; y < last; y++)
        for (int x0 = 0; x0 < job->frame.width; x0 += CHUNK)
            follow_light(job, y, x0, mini(CHUNK, job->frame.width - x0));
}

/* --- Statistics over neighbours of the same mesh ------------------------------------------------------------------ */

static int slot_of(int row) { return (row + RING) % RING; }

/* Pixels of a row around a chunk: mesh -1 outside the image. */
static void read_row(const Job *job, Neighbourhood *around, int y, int x0)
{
    const onespp_frame *frame = &job->frame;
    int32_t *mesh = around->mesh[slot_of(y)];
    float(*pixels)[SPAN] = around->pixels[slot_of(y)];
    int first = maxi(x0 - HALO, 0), last = mini(x0 + CHUNK + HALO, frame->width);
    int left = first - (x0 - HALO), n = last - first;
    for (int i = 0; i < SPAN; i++)
        mesh[i] = -1;
    memset(pixels, 0, sizeof around->pixels[0]);
    if (y < 0 || y >= frame->height)
        return;
    load_mesh(mesh + left, frame, y, first, n);
    for (int c = 0; c < RGB; c++)
        memcpy(pixels[c] + left, row_line(job->d, y, NOISY_LINES + c) + first, sizeof(float) * (size_t)n);
    for (int i = 0; i < SPAN; i++) {
        float bright = minf(luminance(pixels[0][i], pixels[1][i], pixels[2][i]), MAX_LUMINANCE);
        pixels[3][i] = bright;
        pixels[4][i] = bright * bright;
        pixels[5][i] = 1;
    }
}

/* Sums of lines over those of the 3 x 3 taps, `step` pixels apart, that show the same mesh. */
static void sum_taps(
    float (*restrict sums)[SPAN], const Neighbourhood *around, float (*lines)[SUMS][SPAN], int y, int step)
{
    const int32_t *mesh = around->mesh[slot_of(y)];
    memset(sums, 0, sizeof around->sums[0]);
    for (int tap = 0; tap < 9; tap++) {
        int row = slot_of(y + (tap / 3 - 1) * step), shift = (tap % 3 - 1) * step;
        float same[SPAN];
        for (int i = step; i < SPAN - step; i++)
            same[i] = mesh[i] == around->mesh[row][i + shift] ? 1.f : 0.f;
        for (int c = 0; c < SUMS; c++) {
            const float *there = lines[row][c];
            for (int i = step; i < SPAN - step; i++)
                sums[c][i] += same[i] * there[i + shift];
        }
    }
}

/* Moves on to row y of the chunk that begins at x0. */
static void sum_neighbours(const Job *job, Neighbourhood *around, int y, int x0)
{
    for (; around->next <= y + 4; around->next++) {
        int row = around->next - 1;
        read_row(job, around, around->next, x0);
        if (row > around->first)
            sum_taps(around->sums[slot_of(row)], around, around->pixels, row, 1);
    }
    sum_taps(around->sums_9x9, around, around->sums, y, 3);
}

/* --- Layers ------------------------------------------------------------------------------------------------------- */

static inline void fill(float *restrict line, float value)
{
    for (int i = 0; i < LANES; i++)
        line[i] = value;
}

static inline void copy(float *restrict line, const float *restrict from)
{
    for (int i = 0; i < LANES; i++)
        line[i] = from[i];
}

static inline void add_scaled(float *restrict line, float factor, const float *restrict from)
{
    for (int i = 0; i < LANES; i++)
        line[i] += factor * from[i];
}

/* What sums begin with: the bias, or the outputs so far unless they are NULL. */
static inline void begin(float *restrict sums, float bias, const float *restrict outputs)
{
    if (outputs)
        copy(sums, outputs);
    else
        fill(sums, bias);
}

/* The outputs are the sums, or `least` where those are smaller. */
static inline void end(float *restrict outputs, const float *restrict sums, float least)
{
    for (int i = 0; i < LANES; i++)
        outputs[i] = maxf(sums[i], least);
}

/* Prefetches n floats: hardware prefetchers do not follow the jumps from line to line. */
static inline void prefetch(const float *line, int n)
{
    for (int i = 0; i < n; i += ALIGNMENT / (int)sizeof(float))
        PREFETCH(line + i);
}

typedef enum { PLAIN, RECTIFIED, ADDED } Finish; /* ADDED: to what the outputs hold, instead of the bias */

/* LANES pixels of AT_ONCE outputs. Compilers keep these four arrays in vector registers: LANES and AT_ONCE take 12 of 16,
 * or 16 of 32; GCC would run out of them where it inlines this. Each input is read once for all outputs. */
NOINLINE static void multiply_block(
    const float *restrict weights, const float *restrict bias, const float *const *restrict inputs, int count,
    ptrdiff_t x, float *restrict out, ptrdiff_t pitch, Finish finish)
{
    float s0[LANES], s1[LANES], s2[LANES], s3[LANES];
    float *out1 = out + pitch, *out2 = out1 + pitch, *out3 = out2 + pitch;
    for (int o = 0; o < AT_ONCE; o++)
        prefetch(out + o * pitch, LANES);
    begin(s0, bias[0], finish == ADDED ? out : NULL);
    begin(s1, bias[1], finish == ADDED ? out1 : NULL);
    if (AT_ONCE > 2) {
        begin(s2, bias[2], finish == ADDED ? out2 : NULL);
        begin(s3, bias[3], finish == ADDED ? out3 : NULL);
    }
    for (int i = 0; i < count; i++, weights += AT_ONCE) {
        const float *line = inputs[i] + x;
        add_scaled(s0, weights[0], line);
        add_scaled(s1, weights[1], line);
        if (AT_ONCE > 2) {
            add_scaled(s2, weights[2], line);
            add_scaled(s3, weights[3], line);
        }
    }
    float least = finish == RECTIFIED ? 0 : -FLT_MAX;
    end(out, s0, least);
    end(out1, s1, least);
    if (AT_ONCE > 2) {
        end(out2, s2, least);
        end(out3, s3, least);
    }
}

/* Pixels x to x + n - 1 of a layer's outputs, lines `pitch` apart, from lines of inputs. n is rounded up to LANES. */
static void multiply(
    const Layer *layer, const float *const *inputs, ptrdiff_t x, int n, float *out, ptrdiff_t pitch, Finish finish)
{
    for (int i = 0; i < n; i += LANES) /* whose inputs stay in the first cache */
        for (int o = 0; o < layer->outputs; o += AT_ONCE) {
            const float *weights = layer->weights + (ptrdiff_t)o * layer->inputs;
            multiply_block(weights, layer->bias + o, inputs, layer->inputs, x + i, out + o * pitch + i, pitch, finish);
        }
}

/* Pixel 0 of a line of a window. */
static float *line_of(const Window *w, int y, int channel)
{
    return w->data + ((ptrdiff_t)(y - w->first) * w->channels + channel) * w->pitch + PAD;
}

/* Zeros to the left and right of an image's row, which convolutions read. */
static void clear_margins(const Window *w, int y, int width)
{
    for (int c = 0; c < w->channels; c++) {
        float *line = line_of(w, y, c);
        memset(line - PAD, 0, sizeof(float) * PAD);
        memset(line + width, 0, sizeof(float) * (size_t)(w->pitch - PAD - width));
    }
}

/* The size of the image of a window's resolution. */
static int scaled(int size, int channels) { return size / (channels == WIDTH_A ? 2 : channels == WIDTH_B ? 4 : 8); }

/* Whether a convolution of these rows, of which one may be NULL, needs row y - 1 + i and product i. */
static int is_needed(float *const rows[2], int i) { return (i > 0 || rows[0]) && (i < PRODUCTS - 1 || rows[1]); }

/* Of each channel, pixels x - 1 to x + n of the sums of rows y - 1 to y + 2 that a convolution's products need. */
static void sum_rows(
    const Job *job, Convolution *scratch, const Window *from, float *const rows[2], int y, int x, int n)
{
    int height = scaled(job->padded_height, from->channels);
    for (int c = 0; c < from->channels; c++) {
        const float *lines[4];
        for (int i = 0; i < 4; i++) {
            int row = y - 1 + i, is_read = is_needed(rows, i) && row >= 0 && row < height;
            lines[i] = (is_read ? line_of(from, row, c) : job->d->zeros + PAD) + x - 1;
        }
        for (int i = 0; i < n + 2; i++) {
            scratch->sums[0][c][i] = lines[0][i] - lines[2][i];
            scratch->sums[1][c][i] = lines[1][i] + lines[2][i];
            scratch->sums[2][c][i] = lines[2][i] - lines[1][i];
            scratch->sums[3][c][i] = lines[1][i] - lines[3][i];
        }
    }
}

static void rectify_sum(
    float *restrict line, const float *restrict a, float sign, const float *restrict b, const float *restrict c, int n)
{
    for (int i = 0; i < n; i++)
        line[i] = maxf(a[i] + sign * (b[i] + c[i]), 0);
}

/* ReLU of a convolution of 3 x 3: pixels x to x + n - 1 of rows y and y + 1, n at most HALF_CHUNK. Their lines, `pitch`
 * apart, begin at `rows`; one row may be NULL. Winograd's F(2, 3) along columns (Lavin and Gray 2016, section 4.1)
 * multiplies sums of four rows by sums of three weights, which are four products for two rows instead of six. */
static void convolve(
    const Job *job, Convolution *scratch, LayerName name, const Window *from, float *const rows[2], int y, int x,
    int n, ptrdiff_t pitch)
{
    static const float no_bias[WIDTH_C] = {0};
    Layer layer = job->d->layers[name];
    const float *bias = layer.bias, *taps[COLUMNS * WIDTH_C];
    sum_rows(job, scratch, from, rows, y, x, rounded_up(n, LANES));
    for (int product = 0; product < PRODUCTS; product++) {
        for (int i = 0; i < layer.inputs; i++)
            taps[i] = scratch->sums[product][i / COLUMNS] + i % COLUMNS;
        layer.bias = product == 1 ? bias : no_bias; /* this product is in both rows */
        if (is_needed(rows, product))
            multiply(&layer, taps, 0, n, scratch->products[product][0], HALF_LINE, PLAIN);
        layer.weights += (ptrdiff_t)layer.outputs * layer.inputs;
    }
    for (int o = 0; o < layer.outputs; o++) {
        float(*products)[WIDTH_C][HALF_LINE] = scratch->products;
        if (rows[0])
            rectify_sum(rows[0] + o * pitch, products[1][o], 1, products[0][o], products[2][o], n);
        if (rows[1])
            rectify_sum(rows[1] + o * pitch, products[1][o], -1, products[2][o], products[3][o], n);
    }
}

static void convolve_rows(Job *job, Scratch *scratch, int first, int last)
{
    const Window *to = job->to;
    int width = scaled(job->padded_width, to->channels);
    for (int y = first / 2 * 2; y < last; y += 2)
        for (int x = 0; x < width; x += HALF_CHUNK) {
            float *upper = y >= first ? line_of(to, y, 0) + x : NULL;
            float *lower = y + 1 < last ? line_of(to, y + 1, 0) + x : NULL;
            float *rows[2] = {upper, lower};
            int n = mini(HALF_CHUNK, width - x);
            convolve(job, &scratch->convolution, job->layer, job->from, rows, y, x, n, to->pitch);
        }
    for (int y = first; y < last; y++)
        clear_margins(to, y, width);
}

/* ReLU of a convolution of 2 x 2 pixels, which become one. Lines of such patches are in the order of rows, columns,
 * channels. */
static void halve_rows(Job *job, Scratch *scratch, int first, int last)
{
    const Window *from = job->from, *to = job->to;
    const float *lines[PATCH * WIDTH_B];
    int width = scaled(job->padded_width, to->channels), channels = from->channels;
    for (int i = 0; i < PATCH * channels; i++)
        lines[i] = scratch->patches[i];
    for (int y = first; y < last; y++) {
        for (int x = 0; x < width; x += HALF_CHUNK) {
            int n = mini(HALF_CHUNK, width - x);
            for (int i = 0; i < 2 * channels; i++) {
                int even = i / channels * 2 * channels + i % channels;
                const float *line = line_of(from, 2 * y + i / channels, i % channels) + 2 * x;
                split(scratch->patches[even], scratch->patches[even + channels], line, n);
            }
            multiply(&job->d->layers[job->layer], lines, 0, n, line_of(to, y, 0) + x, to->pitch, RECTIFIED);
        }
        clear_margins(to, y, width);
    }
}

/* A transposed convolution, of a pixel to 2 x 2, added to `skip`; the rows are those of `from`. */
static void double_rows(Job *job, Scratch *scratch, int first, int last)
{
    const Window *from = job->from, *skip = job->skip, *to = job->to;
    const float *lines[WIDTH_C];
    int width = scaled(job->padded_width, from->channels), channels = to->channels;
    for (int y = first; y < last; y++) {
        for (int c = 0; c < from->channels; c++)
            lines[c] = line_of(from, y, c);
        for (int x = 0; x < width; x += HALF_CHUNK) {
            int n = mini(HALF_CHUNK, width - x);
            multiply(&job->d->layers[job->layer], lines, x, n, scratch->patches[0], HALF_LINE, PLAIN);
            for (int i = 0; i < 2 * channels; i++) {
                int even = i / channels * 2 * channels + i % channels;
                const float *restrict old = line_of(skip, 2 * y + i / channels, i % channels) + 2 * x;
                float *restrict line = line_of(to, 2 * y + i / channels, i % channels) + 2 * x;
                join(line, scratch->patches[even], scratch->patches[even + channels], n);
                for (int k = 0; k < 2 * n; k++)
                    line[k] += old[k];
            }
        }
        clear_margins(to, 2 * y, 2 * width);
        clear_margins(to, 2 * y + 1, 2 * width);
    }
}

/* --- Inputs of the network ---------------------------------------------------------------------------------------- */

/* Its input lines. */
enum {
    NOISY_INPUT = 0,
    MEAN_3X3_INPUT = NOISY_INPUT + RGB,
    MEAN_9X9_INPUT = MEAN_3X3_INPUT + RGB,
    OUTPUT_INPUT = MEAN_9X9_INPUT + RGB,
    ACCUMULATED_INPUT = OUTPUT_INPUT + RGB,
    DEVIATION_INPUT = ACCUMULATED_INPUT + RGB, /* relative, of luminance over 9 x 9 pixels */
    NEWEST_INPUT,                              /* 1 / samples */
    OLDEST_INPUT,                              /* 1 / (samples and length of the history) */
    HAS_HISTORY_INPUT,
    LATENT_INPUT,
    ALBEDO_INPUT = LATENT_INPUT + LATENT,
    NORMAL_INPUT = ALBEDO_INPUT + RGB,
    DEPTH_INPUT = NORMAL_INPUT + 3,
    ROUGHNESS_INPUT
};

/* ln(1 + exposure times light). */
static void expose(float *restrict line, const float *restrict light, float exposure, int n)
{
    for (int i = 0; i < n; i++)
        line[i] = 1 + minf(maxf(light[i], 0) * exposure, MAX_EXPOSED);
    for (int i = 0; i < n; i++)
        line[i] = logarithm(line[i]);
}

/* The lines that are means of irradiance, and its deviation; and the luminance beyond which pixels are outliers. */
static void fill_statistics(
    const Job *job, const Neighbourhood *around, int y, int n, float (*restrict lines)[LINE], float *restrict most)
{
    int slot = slot_of(y);
    const float *count = around->sums_9x9[5] + HALO;
    float mean[LINE], square[LINE], means[RGB][LINE];
    for (int c = 0; c < RGB; c++) {
        expose(lines[NOISY_INPUT + c], around->pixels[slot][c] + HALO, job->exposure, n);
        for (int i = 0; i < n; i++)
            mean[i] = around->sums[slot][c][HALO + i] / around->sums[slot][5][HALO + i];
        expose(lines[MEAN_3X3_INPUT + c], mean, job->exposure, n);
        for (int i = 0; i < n; i++)
            means[c][i] = around->sums_9x9[c][HALO + i] / count[i];
        expose(lines[MEAN_9X9_INPUT + c], means[c], job->exposure, n);
    }
    for (int i = 0; i < n; i++)
        most[i] = OUTLIER * luminance(means[0][i], means[1][i], means[2][i]);
    for (int i = 0; i < n; i++) {
        mean[i] = around->sums_9x9[3][HALO + i] / count[i];
        square[i] = mean[i] * mean[i];
    }
    for (int i = 0; i < n; i++) {
        /* Of pixels that are all alike this is exactly 0, as long as the square is rounded: it has a loop of its own. */
        float variance = maxf(around->sums_9x9[4][HALO + i] / count[i] - square[i], 0);
        mean[i] = sqrtf(variance) / maxf(mean[i], MIN_MEAN);
    }
    expose(lines[DEVIATION_INPUT], mean, 1, n);
}

/* The lines of the reprojected history; without one, its images are those of this frame. */
static void fill_history(const Job *job, int y, int x0, int n, float (*restrict lines)[LINE])
{
    const onespp *d = job->d;
    float samples = job->frame.samples;
    const float *length = row_line(d, y, LENGTH_LINE) + x0;
    for (int c = 0; c < RGB; c++) {
        float *output = lines[OUTPUT_INPUT + c], *accumulated = lines[ACCUMULATED_INPUT + c];
        expose(output, row_line(d, y, OUTPUT_LINES + c) + x0, job->exposure, n);
        expose(accumulated, row_line(d, y, ACCUMULATED_LINES + c) + x0, job->exposure, n);
        for (int i = 0; i < n; i++) {
            output[i] = length[i] > 0 ? output[i] : lines[MEAN_9X9_INPUT + c][i];
            accumulated[i] = length[i] > 0 ? accumulated[i] : lines[NOISY_INPUT + c][i];
        }
    }
    for (int i = 0; i < n; i++) {
        lines[NEWEST_INPUT][i] = 1 / samples;
        lines[OLDEST_INPUT][i] = 1 / (length[i] + samples);
        lines[HAS_HISTORY_INPUT][i] = length[i] > 0 ? 1.f : 0.f;
    }
    for (int c = 0; c < LATENT; c++)
        memcpy(lines[LATENT_INPUT + c], row_line(d, y, LATENT_LINES + c) + x0, sizeof(float) * (size_t)n);
}

/* The lines of surfaces: albedo, normal in view space, depth and roughness. */
static void fill_surface(const Job *job, int y, int x0, int n, float (*restrict lines)[LINE])
{
    const onespp_frame *frame = &job->frame;
    float normal[3][LINE];
    for (int c = 0; c < 3; c++) {
        load(lines[ALBEDO_INPUT + c], &frame->albedo, c, y, x0, n);
        load_normal(normal[c], frame, c, y, x0, n);
        for (int i = 0; i < n; i++)
            lines[ALBEDO_INPUT + c][i] = clamped(lines[ALBEDO_INPUT + c][i], MAX_REFLECTANCE);
    }
    for (int c = 0; c < 3; c++) {
        const float *axis = job->to_view[c];
        for (int i = 0; i < n; i++)
            lines[NORMAL_INPUT + c][i] = axis[0] * normal[0][i] + axis[1] * normal[1][i] + axis[2] * normal[2][i];
    }
    float *restrict depth = lines[DEPTH_INPUT], *restrict roughness = lines[ROUGHNESS_INPUT], scale = job->depth_scale;
    load(depth, &frame->depth, 0, y, x0, n);
    load(roughness, &frame->roughness, 0, y, x0, n);
    for (int i = 0; i < n; i++) {
        float share = depth[i] / (depth[i] + scale);
        depth[i] = depth[i] > 0 ? share : 1;
        roughness[i] = clamped(roughness[i], MAX_REFLECTANCE);
    }
}

/* The inputs of a chunk of a row, n pixels from x0 on, whose last one is repeated. */
static void fill_inputs(const Job *job, Scratch *scratch, int y, int x0, int n, float (*restrict lines)[LINE])
{
    sum_neighbours(job, &scratch->enter.around, y, x0);
    fill_statistics(job, &scratch->enter.around, y, n, lines, scratch->enter.most);
    fill_history(job, y, x0, n, lines);
    fill_surface(job, y, x0, n, lines);
    for (int c = 0; c < INPUTS; c++)
        for (int i = n; i < CHUNK; i++)
            lines[c][i] = lines[c][n - 1];
}

/* What `leave` needs of a chunk of a row: how bright an outlier is, and the hidden per-pixel layer. */
static void keep_row(const Job *job, Scratch *scratch, int y, int x0, int n, float (*lines)[LINE])
{
    const onespp *d = job->d;
    const float *inputs[INPUTS];
    memcpy(row_line(d, y, OUTLIER_LINE) + x0, scratch->enter.most, sizeof(float) * (size_t)n);
    for (int c = 0; c < INPUTS; c++)
        inputs[c] = lines[c];
    multiply(&d->layers[DETAIL_1], inputs, 0, n, line_of(&d->hidden, y, 0) + x0, d->hidden.pitch, RECTIFIED);
}

/* The first layers of the network of a chunk, n pixels at 1/2 of the resolution, from the inputs of two rows. */
static void enter_chunk(const Job *job, Scratch *scratch, int y, int x, int n)
{
    const onespp *d = job->d;
    const float *patches[PATCH * INPUTS], *entered[WIDTH_A];
    for (int i = 0; i < 2 * INPUTS; i++) {
        int even = i / INPUTS * 2 * INPUTS + i % INPUTS;
        float(*to)[HALF_LINE] = scratch->enter.patches;
        split(to[even], to[even + INPUTS], scratch->enter.lines[i / INPUTS][i % INPUTS], HALF_CHUNK);
    }
    for (int i = 0; i < PATCH * INPUTS; i++)
        patches[i] = scratch->enter.patches[i];
    for (int c = 0; c < WIDTH_A; c++)
        entered[c] = scratch->enter.entered[c];
    multiply(&d->layers[ENTER_1], patches, 0, n, scratch->enter.entered[0], HALF_LINE, RECTIFIED);
    multiply(&d->layers[ENTER_2], entered, 0, n, line_of(&d->a, y, 0) + x, d->a.pitch, RECTIFIED);
}

/* The rows are those of 1/2 of the resolution. */
static void enter_rows(Job *job, Scratch *scratch, int first, int last)
{
    const onespp_frame *frame = &job->frame;
    for (int x0 = 0; x0 < job->padded_width; x0 += CHUNK) {
        int n = mini(CHUNK, frame->width - x0), padded = mini(CHUNK, job->padded_width - x0);
        scratch->enter.around.first = scratch->enter.around.next = mini(2 * first, frame->height - 1) - 4;
        for (int y = first; y < last; y++) {
            for (int i = 0; i < 2; i++) {
                /* Below the image its last row is repeated. */
                int row = 2 * y + i, source = mini(row, frame->height - 1);
                fill_inputs(job, scratch, source, x0, n, scratch->enter.lines[i]);
                if (row == source)
                    keep_row(job, scratch, row, x0, n, scratch->enter.lines[i]);
            }
            enter_chunk(job, scratch, y, x0 / 2, padded / 2);
        }
    }
    for (int y = first; y < last; y++)
        clear_margins(&job->d->a, y, job->padded_width / 2);
}

/* --- Outputs of the network --------------------------------------------------------------------------------------- */

/* Its output lines. */
enum {
    SHARPNESS_HEAD = FEATURES,
    CENTRE_HEAD = SHARPNESS_HEAD + LEVELS,
    IMPORTANCE_HEAD = CENTRE_HEAD + LEVELS,
    ALPHA_HEAD = IMPORTANCE_HEAD + LEVELS,
    LATENT_HEAD = ALPHA_HEAD + 2
};

/* The parameters of a level of the filter. */
static void decode_level(
    const Job *job, float (*head)[LINE], const float *restrict depth, int level, int y, int x0, int n)
{
    float *restrict sharpness = row_line(job->d, y, LEVEL_LINES + 3 * level) + x0;
    float *restrict centre = sharpness + job->d->pitch, *restrict importance = centre + job->d->pitch;
    float shrunk[LINE]; /* of softplus */
    for (int i = 0; i < n; i++)
        shrunk[i] = exponential(maxf(-fabsf(head[SHARPNESS_HEAD + level][i]), -MAX_EXPONENT));
    for (int i = 0; i < n; i++) {
        sharpness[i] = maxf(head[SHARPNESS_HEAD + level][i], 0) + logarithm(1 + shrunk[i]);
        centre[i] = clamped(head[CENTRE_HEAD + level][i], MAX_LOGIT);
        importance[i] = depth[i] > 0 ? clamped(head[IMPORTANCE_HEAD + level][i], MAX_LOGIT) : NO_WEIGHT;
    }
}

/* Weights of the newest frame, 1 without history; the new accumulation, and its length: that of a mean as noisy. */
static void accumulate(const Job *job, Scratch *scratch, int y, int x0, int n)
{
    const onespp *d = job->d;
    float samples = job->frame.samples, newest[LINE];
    const float *head = scratch->leave.head[ALPHA_HEAD], *output_head = scratch->leave.head[ALPHA_HEAD + 1];
    float *restrict alpha = row_line(d, y, ALPHA_LINE) + x0, *restrict length = row_line(d, y, LENGTH_LINE) + x0;
    for (int i = 0; i < n; i++) {
        float past = maxf(length[i], MIN_LENGTH);
        float against = exponential(clamped(-head[i], MAX_EXPONENT)) * past / samples;
        float against_output = exponential(clamped(-output_head[i], MAX_EXPONENT));
        newest[i] = length[i] > 0 ? 1 / (1 + against) : 1;
        alpha[i] = length[i] > 0 ? 1 / (1 + against_output) : 1;
        float kept = 1 - newest[i];
        length[i] = 1 / (newest[i] * newest[i] / samples + kept * kept / past);
    }
    for (int c = 0; c < RGB; c++) {
        float *restrict accumulated = row_line(d, y, ACCUMULATED_LINES + c) + x0;
        const float *restrict noisy = scratch->leave.noisy[c];
        for (int i = 0; i < n; i++)
            accumulated[i] = newest[i] * noisy[i] + (1 - newest[i]) * accumulated[i];
    }
    for (int c = 0; c < RGB * job->frame.parts; c++) {
        float noisy[LINE], *restrict accumulated = part_line(d, y, c / RGB, PART_ACCUMULATED + c % RGB) + x0;
        load_part(noisy, &job->frame, c / RGB, c % RGB, y, x0, n);
        for (int i = 0; i < n; i++)
            accumulated[i] = newest[i] * noisy[i] + (1 - newest[i]) * accumulated[i];
    }
}

/* The share of the accumulation that is spread: what is over the luminance where outliers begin. */
static void find_outliers(const onespp *d, int y, int x0, int n)
{
    float *restrict share = row_line(d, y, OUTLIER_LINE) + x0;
    const float *red = row_line(d, y, ACCUMULATED_LINES) + x0, *green = red + d->pitch, *blue = green + d->pitch;
    for (int i = 0; i < n; i++) {
        float bright = luminance(red[i], green[i], blue[i]), most = share[i];
        share[i] = bright > most ? (bright - most) / bright : 0;
    }
}

static void decode_latent(const Job *job, float (*head)[LINE], int y, int x0, int n)
{
    for (int c = 0; c < LATENT; c++) {
        float *restrict latent = row_line(job->d, y, LATENT_LINES + c) + x0;
        for (int i = 0; i < n; i++) { /* tanh */
            float x = head[LATENT_HEAD + c][i];
            float shrunk = exponential(maxf(-2 * fabsf(x), -MAX_EXPONENT));
            float size = (1 - shrunk) / (1 + shrunk);
            latent[i] = x > 0 ? size : -size;
        }
    }
}

static void fill_margins(const Job *job, float *line, float value)
{
    for (int i = 1; i <= MARGIN; i++)
        line[-i] = line[job->frame.width - 1 + i] = value;
}

/* Pixels beside the image count as ones that show no surface. What they have no weight for must be finite all the same. */
static void exclude_margins(const Job *job, int y)
{
    for (int c = 0; c < FEATURES; c++)
        fill_margins(job, row_line(job->d, y, FEATURE_LINES + c), 0);
    for (int c = 0; c < 3 * LEVELS; c++)
        fill_margins(job, row_line(job->d, y, LEVEL_LINES + c), c % 3 == 2 ? NO_WEIGHT : 0);
    fill_margins(job, row_line(job->d, y, GUIDE_LINE), 0);
    int32_t *mesh = mesh_line(job->d, &job->d->next, y);
    for (int i = 1; i <= MARGIN; i++)
        mesh[-i] = mesh[job->frame.width - 1 + i] = BACKGROUND;
}

/* Decodes a chunk of a row. */
static void decode(const Job *job, Scratch *scratch, int y, int x0, int n)
{
    float(*head)[LINE] = scratch->leave.head;
    load(scratch->leave.depth, &job->frame.depth, 0, y, x0, n);
    load_mesh(mesh_line(job->d, &job->d->next, y) + x0, &job->frame, y, x0, n); /* the past ones were read */
    for (int c = 0; c < RGB; c++)
        memcpy(scratch->leave.noisy[c], row_line(job->d, y, NOISY_LINES + c) + x0, sizeof(float) * (size_t)n);
    for (int c = 0; c < FEATURES; c++)
        memcpy(row_line(job->d, y, FEATURE_LINES + c) + x0, head[c], sizeof(float) * (size_t)n);
    for (int level = 0; level < LEVELS; level++)
        decode_level(job, head, scratch->leave.depth, level, y, x0, n);
    if (x0 == 0)
        exclude_margins(job, y);
    accumulate(job, scratch, y, x0, n);
    find_outliers(job->d, y, x0, n);
    decode_latent(job, head, y, x0, n);
}

/* Two rows of a chunk, n pixels from x0 on, from a row y at 1/2 of the resolution, whose channels are `joined`. */
static void leave_chunk(const Job *job, Scratch *scratch, float (*joined)[HALF_LINE], int y, int x0, int n)
{
    const onespp *d = job->d;
    const float *lines[WIDTH_A], *hidden[DETAIL];
    float(*patches)[HALF_LINE] = scratch->leave.patches;
    for (int c = 0; c < WIDTH_A; c++)
        lines[c] = joined[c];
    for (int row = 2 * y; row < mini(2 * y + 2, job->frame.height); row++)
        for (int c = 0; c < DETAIL; c++)
            prefetch(line_of(&d->hidden, row, c) + x0, n);
    multiply(&d->layers[LEAVE], lines, 0, n / 2 + n % 2, patches[0], HALF_LINE, PLAIN);
    for (int row = 2 * y; row < mini(2 * y + 2, job->frame.height); row++) {
        int even = row % 2 * 2 * OUTPUTS;
        for (int c = 0; c < OUTPUTS; c++)
            join(scratch->leave.head[c], patches[even + c], patches[even + OUTPUTS + c], HALF_CHUNK);
        for (int c = 0; c < DETAIL; c++)
            hidden[c] = line_of(&d->hidden, row, c) + x0;
        multiply(&d->layers[DETAIL_2], hidden, 0, n, scratch->leave.head[0], LINE, ADDED);
        decode(job, scratch, row, x0, n);
    }
}

/* The rows are those of 1/2 of the resolution. */
static void leave_rows(Job *job, Scratch *scratch, int first, int last)
{
    Convolution *convolution = &scratch->leave.convolution;
    for (int y = first / 2 * 2; y < last; y += 2)
        for (int x = 0; x < job->padded_width / 2; x += HALF_CHUNK) {
            int n = mini(CHUNK, job->frame.width - 2 * x);
            float(*joined)[WIDTH_A][HALF_LINE] = scratch->leave.joined;
            float *rows[2] = {y >= first ? joined[0][0] : NULL, y + 1 < last ? joined[1][0] : NULL};
            convolve(job, convolution, JOIN_A, &job->d->sum_a, rows, y, x, n / 2 + n % 2, HALF_LINE);
            for (int i = 0; i < 2; i++)
                if (rows[i])
                    leave_chunk(job, scratch, joined[i], y + i, 2 * x, n);
        }
}

/* --- The network, strip by strip ---------------------------------------------------------------------------------- */

/* Moves what is stored of rows before `end` so that a window begins with row `first`. */
static void scroll(Window *w, int first, int end)
{
    size_t row = sizeof(float) * (size_t)(w->channels * w->pitch);
    if (end > first)
        memmove(w->data, w->data + (ptrdiff_t)(first - w->first) * w->channels * w->pitch, row * (size_t)(end - first));
    w->first = first;
}

/* Does `work` for those of the rows first to last - 1 that are in the image. */
static void run_layer(
    Job *job, void (*work)(Job *, Scratch *, int, int), LayerName layer, const Window *from, const Window *to,
    int first, int last)
{
    int height = scaled(job->padded_height, work == double_rows ? from->channels : to->channels);
    job->layer = layer;
    job->from = from;
    job->to = to;
    run(job, work, maxi(first, 0), mini(last, height));
}

/* Rows first to last - 1 at 1/8 of the resolution, after `entered` rows of 1/2; returns how many there are then. */
static int run_strip(Job *job, int first, int last, int entered)
{
    onespp *d = job->d;
    int end = mini(4 * last + REACH_A, job->padded_height / 2);
    scroll(&d->a, maxi(4 * first - REACH_A, 0), entered);
    scroll(&d->hidden, 8 * first, 2 * entered);
    d->b.first = d->b_too.first = maxi(2 * (first - REACH_C) - 1, 0);
    d->c.first = d->c_too.first = maxi(first - REACH_C, 0);
    d->sum_a.first = maxi(4 * first - 2, 0);

    run(job, enter_rows, entered, end);
    run_layer(job, halve_rows, DOWN_B, &d->a, &d->b, 2 * (first - REACH_C) - 1, 2 * (last + REACH_C) + 1);
    run_layer(job, convolve_rows, CONVOLVE_B, &d->b, &d->b_too, 2 * (first - REACH_C), 2 * (last + REACH_C));
    run_layer(job, halve_rows, DOWN_C, &d->b_too, &d->c, first - REACH_C, last + REACH_C);
    run_layer(job, convolve_rows, CONVOLVE_C1, &d->c, &d->c_too, first - 2, last + 2);
    run_layer(job, convolve_rows, CONVOLVE_C2, &d->c_too, &d->c, first - 1, last + 1);
    job->skip = &d->b_too;
    run_layer(job, double_rows, UP_B, &d->c, &d->b, first - 1, last + 1);
    run_layer(job, convolve_rows, JOIN_B, &d->b, &d->b_too, 2 * first - 1, 2 * last + 1);
    job->skip = &d->a;
    run_layer(job, double_rows, UP_A, &d->b_too, &d->sum_a, 2 * first - 1, 2 * last + 1);
    run(job, leave_rows, 4 * first, 4 * last);
    return end;
}

static void run_network(Job *job)
{
    int rows = job->padded_height / 8, step = strip_height(&job->d->config), entered = 0;
    job->d->a.first = job->d->hidden.first = 0;
    for (int first = 0; first < rows; first += step)
        entered = run_strip(job, first, mini(first + step, rows), entered);
}

/* --- The filter --------------------------------------------------------------------------------------------------- */

/* A line of a pass's output: colours and mass, then colours of parts of the light. It is in the texels, which are no longer
 * needed and have room for two images, in turn; as the last pass writes texels, what that filters is over the first
 * parameters. Pass -1 is what pass 0 filters. */
static float *filtered_line(const onespp *d, int pass, int y, int channel)
{
    int turn = (pass + 1) % 2, of_part = channel - FILTERED;
    if (of_part >= 0)
        return part_line(d, y, of_part / RGB, PART_FILTERED + RGB * turn + of_part % RGB);
    if (pass == PASSES - 2)
        return row_line(d, y, LEVEL_LINES + channel);
    return d->next.texels + ((ptrdiff_t)y * TEXEL + FILTERED * turn + channel) * d->pitch + MARGIN;
}

static int filtered_channels(const Job *job) { return FILTERED + RGB * job->frame.parts; }

/* A line of squared distances. A task has those of two rows, and uses them in turn: `turn` is 0 or 1. */
static float *distance_line(const onespp *d, const Scratch *scratch, int turn, int direction)
{
    ptrdiff_t line = ((scratch - d->scratch) * 2 + turn) * DIRECTIONS + direction;
    return d->distances + line * d->pitch + MARGIN;
}

/* The squared distances of the features, in lines `pitch` apart, of n pixels. */
static void measure_features(
    float *const *distances, const float *restrict here, const float *restrict below, ptrdiff_t pitch, int step, int n)
{
    float *restrict right = distances[RIGHT], *restrict left_below = distances[LEFT_BELOW];
    float *restrict straight_below = distances[BELOW], *restrict right_below = distances[RIGHT_BELOW];
    for (int i = 0; i < n; i++) {
        float to_right = 0, to_left_below = 0, to_below = 0, to_right_below = 0;
        for (int f = 0; f < FEATURES; f++) {
            const float *beside = here + f * pitch + i, *tap = below + f * pitch + i;
            float value = beside[0];
            to_right += (value - beside[step]) * (value - beside[step]);
            to_left_below += (value - tap[-step]) * (value - tap[-step]);
            to_below += (value - tap[0]) * (value - tap[0]);
            to_right_below += (value - tap[step]) * (value - tap[step]);
        }
        right[i] = to_right;
        left_below[i] = to_left_below;
        straight_below[i] = to_below;
        right_below[i] = to_right_below;
    }
}

/* Meshes that differ are farther away. */
static void add_meshes(
    float *const *distances, const int32_t *restrict here, const int32_t *restrict below, int step, int n)
{
    float *restrict right = distances[RIGHT], *restrict left_below = distances[LEFT_BELOW];
    float *restrict straight_below = distances[BELOW], *restrict right_below = distances[RIGHT_BELOW];
    for (int i = 0; i < n; i++) {
        right[i] += here[i] == here[i + step] ? 0.f : MESH_DISTANCE;
        left_below[i] += here[i] == below[i - step] ? 0.f : MESH_DISTANCE;
        straight_below[i] += here[i] == below[i] ? 0.f : MESH_DISTANCE;
        right_below[i] += here[i] == below[i + step] ? 0.f : MESH_DISTANCE;
    }
}

/* Measures the squared distances of n pixels to the taps to the right and below: those to the other taps were measured
 * there. In the last row, which has none below, only the distances to the right are used. */
static void measure_pairs(const Job *job, const Scratch *scratch, int turn, int y, int x0, int n)
{
    const onespp *d = job->d;
    int step = TAP_SPACINGS[job->pass], below = mini(y + step, job->frame.height - 1);
    const float *features = row_line(d, y, FEATURE_LINES) + x0, *taps = row_line(d, below, FEATURE_LINES) + x0;
    float *distances[DIRECTIONS];
    for (int i = 0; i < DIRECTIONS; i++)
        distances[i] = distance_line(d, scratch, turn, i) + x0;
    measure_features(distances, features, taps, d->pitch, step, n);
    add_meshes(distances, mesh_line(d, &d->next, y) + x0, mesh_line(d, &d->next, below) + x0, step, n);
}

/* The squared distances of n pixels from a tap. */
static const float *distances_from(const Job *job, const Scratch *scratch, int turn, int tap, int x0)
{
    int step = TAP_SPACINGS[job->pass], column = tap % 3 - 1;
    if (tap > TAPS / 2)
        return distance_line(job->d, scratch, turn, tap - TAPS / 2 - 1) + x0;
    /* The pixel is a tap of that one, in the opposite direction. */
    int measured = tap < 3 ? !turn : turn;
    return distance_line(job->d, scratch, measured, TAPS / 2 - 1 - tap) + x0 + column * step;
}

/* Squared distances with those of the guide: the more samples a pixel has, the less noise there is in it. */
static void add_guide(
    float *restrict guided, const float *restrict distance, const float *restrict here, const float *restrict there,
    const float *restrict samples, int n)
{
    for (int i = 0; i < n; i++)
        guided[i] = distance[i] + GUIDANCE * samples[i] * (here[i] - there[i]) * (here[i] - there[i]);
}

/* Weights of a tap of n pixels: exp(importance of the tap - sharpness of the pixel times their distance). They are added to
 * `total`. */
static void weigh_tap(
    float *restrict weight, float *restrict total, const float *restrict distance, const float *restrict sharpness,
    const float *restrict importance, int n)
{
    for (int i = 0; i < n; i++) {
        float exponent = maxf(importance[i] - sharpness[i] * distance[i], MIN_LOGIT);
        weight[i] = importance[i] > NO_WEIGHT ? exponential(exponent) : 0;
        total[i] += weight[i];
    }
}

/* Weights of 3 x 3 taps of n pixels: Isik et al. 2021, Eq. 4, with two weights more, of which `centre` is the pixel's own.
 * `scale` becomes 1 / their sum, or 0 off surfaces. */
static void weigh_taps(
    const Job *job, const Scratch *scratch, int turn, float (*restrict weights)[LINE], float *restrict scale, int y,
    int x0, int n)
{
    const onespp *d = job->d;
    int step = TAP_SPACINGS[job->pass], line = LEVEL_LINES + 3 * PASS_LEVELS[job->pass];
    const float *sharpness = row_line(d, y, line) + x0, *centre = sharpness + d->pitch, *importance = centre + d->pitch;
    const float *guide = row_line(d, y, GUIDE_LINE) + x0, *samples = row_line(d, y, LENGTH_LINE) + x0;
    float guided[LINE];
    for (int i = 0; i < n; i++)
        scale[i] = weights[TAPS / 2][i] = exponential(centre[i]);
    for (int tap = 0; tap < TAPS; tap++) {
        int row = y + (tap / 3 - 1) * step, x = x0 + (tap % 3 - 1) * step;
        if (tap == TAPS / 2)
            continue;
        if (row < 0 || row >= job->frame.height) {
            memset(weights[tap], 0, sizeof(float) * (size_t)n);
            continue;
        }
        const float *distance = distances_from(job, scratch, turn, tap, x0);
        if (job->pass >= FIRST_GUIDED) {
            add_guide(guided, distance, guide, row_line(d, row, GUIDE_LINE) + x, samples, n);
            distance = guided;
        }
        weigh_tap(weights[tap], scale, distance, sharpness, row_line(d, row, line + 2) + x, n);
    }
    for (int i = 0; i < n; i++)
        scale[i] = importance[i] > NO_WEIGHT ? 1 / scale[i] : 0;
}

static inline float sum_row(float (*restrict weights)[LINE], const float *restrict from, int step, int i)
{
    return weights[0][i] * from[i - step] + weights[1][i] * from[i] + weights[2][i] * from[i + step];
}

/* Weighted sums of the taps, in three rows, of n pixels, times `scale`. */
static void sum_weighted(
    float *restrict to, float (*restrict weights)[LINE], const float *restrict scale, const float *const *rows, int step,
    int n)
{
    const float *restrict above = rows[0], *restrict here = rows[1], *restrict below = rows[2];
    for (int i = 0; i < n; i++)
        to[i] = sum_row(weights, above, step, i) + sum_row(weights + 3, here, step, i);
    for (int i = 0; i < n; i++)
        to[i] = scale[i] * (to[i] + sum_row(weights + 6, below, step, i));
}

/* A pass of the filter at n pixels of a row: `to` has a line for each channel. */
static void filter_chunk(const Job *job, const Scratch *scratch, int turn, float *const *to, int y, int x0, int n)
{
    int step = TAP_SPACINGS[job->pass];
    float weights[TAPS][LINE], scale[LINE];
    measure_pairs(job, scratch, turn, y, x0, n);
    weigh_taps(job, scratch, turn, weights, scale, y, x0, n);
    for (int c = 0; c < filtered_channels(job); c++) {
        const float *rows[3];
        for (int i = 0; i < 3; i++) { /* rows outside the image have no weight */
            int row = maxi(0, mini(y + (i - 1) * step, job->frame.height - 1));
            rows[i] = filtered_line(job->d, job->pass - 1, row, c) + x0;
        }
        sum_weighted(to[c], weights, scale, rows, step, n);
    }
}

/* What is filtered in a channel: the accumulation, or ones, which become the sum of the weights of all else. */
static const float *accumulated_line(const onespp *d, int y, int channel)
{
    if (channel == MASS)
        return d->ones;
    int of_part = channel - FILTERED;
    return of_part < 0 ? row_line(d, y, ACCUMULATED_LINES + channel)
                       : part_line(d, y, of_part / RGB, PART_ACCUMULATED + of_part % RGB);
}

/* Outliers alone, before the first pass; when they are spread, what else was accumulated is added. */
static void split_rows(Job *job, Scratch *scratch, int first, int last)
{
    (void)scratch;
    for (int y = first; y < last; y++)
        for (int c = 0; c < filtered_channels(job); c++) {
            const float *restrict share = row_line(job->d, y, OUTLIER_LINE);
            const float *restrict accumulated = accumulated_line(job->d, y, c);
            float *restrict to = filtered_line(job->d, job->pass, y, c);
            if (job->pass < 0) {
                fill_margins(job, to, 0);
                fill_margins(job, filtered_line(job->d, 0, y, c), 0);
            }
            for (int i = 0; i < job->frame.width; i++) {
                float outliers = share[i] * accumulated[i];
                to[i] = job->pass < 0 ? outliers : to[i] + (accumulated[i] - outliers);
            }
        }
}

/* The guide of the next pass: the luminance that there is, exposed. */
static void guide_rows(Job *job, Scratch *scratch, int first, int last)
{
    (void)scratch;
    float bright[LINE];
    for (int y = first; y < last; y++)
        for (int x0 = 0; x0 < job->frame.width; x0 += CHUNK) {
            int n = mini(CHUNK, job->frame.width - x0);
            const float *lines[FILTERED];
            float *guide = row_line(job->d, y, GUIDE_LINE) + x0;
            for (int c = 0; c < FILTERED; c++)
                lines[c] = filtered_line(job->d, job->pass - 1, y, c) + x0;
            for (int i = 0; i < n; i++)
                bright[i] = luminance(lines[0][i], lines[1][i], lines[2][i]) / maxf(lines[MASS][i], MIN_MASS);
            expose(guide, bright, job->exposure / DARKEST, n);
        }
}

/* The row that a pass filters as number `index`. Rows `step` apart follow each other, for they share taps: chains of
 * height / step rows, and of one more in the first height % step of them. */
static int row_in_order(int index, int step, int height)
{
    int rows = height / step, longer = height % step, of_longer = longer * (rows + 1);
    if (index < of_longer)
        return index / (rows + 1) + index % (rows + 1) * step;
    index -= of_longer;
    return longer + index / rows + index % rows * step;
}

/* Filters the rows `first` to `last` - 1 of that order; `leave` gets each chunk. */
static void filter_in_order(
    Job *job, Scratch *scratch, int first, int last,
    void (*leave)(Job *job, const Scratch *scratch, int turn, int y, int x0, int n))
{
    int step = TAP_SPACINGS[job->pass], width = job->frame.width, turn = 0, before = -1;
    for (int index = first; index < last; index++) {
        int y = row_in_order(index, step, job->frame.height);
        if (y >= step && before != y - step) /* else this was measured before, or there is no row above */
            for (int x0 = 0; x0 < width; x0 += CHUNK)
                measure_pairs(job, scratch, !turn, y - step, x0, mini(CHUNK, width - x0));
        for (int x0 = 0; x0 < width; x0 += CHUNK)
            leave(job, scratch, turn, y, x0, mini(CHUNK, width - x0));
        before = y;
        turn = !turn;
    }
}

/* A chunk of what all passes but the last leave. */
static void filter_to_lines(Job *job, const Scratch *scratch, int turn, int y, int x0, int n)
{
    float *to[MAX_FILTERED];
    for (int c = 0; c < filtered_channels(job); c++)
        to[c] = filtered_line(job->d, job->pass, y, c) + x0;
    filter_chunk(job, scratch, turn, to, y, x0, n);
}

static void filter_rows(Job *job, Scratch *scratch, int first, int last)
{
    filter_in_order(job, scratch, first, last, filter_to_lines);
}

/* --- The end of a frame ------------------------------------------------------------------------------------------- */

/* What the next frame's reprojection reads. */
static void remember(const Job *job, int y, int x0, int n)
{
    const onespp *d = job->d;
    ptrdiff_t pixel = (ptrdiff_t)y * d->pitch + x0;
    float normal[3][LINE];
    const float *lines[TEXEL];
    for (int c = 0; c < HISTORY; c++)
        lines[c] = row_line(d, y, OUTPUT_LINES + c) + x0;
    for (int c = 0; c < 3; c++) {
        load_normal(normal[c], &job->frame, c, y, x0, n);
        lines[NORMAL + c] = normal[c];
    }
    join_texels(d->next.texels + pixel * TEXEL, lines, n);
    int of_parts = PART_HISTORY * job->frame.parts;
    for (int c = 0; c < of_parts; c++) {
        const float *line = part_line(d, y, c / PART_HISTORY, c % PART_HISTORY) + x0;
        for (int i = 0; i < n; i++)
            d->next.part_texels[(pixel + i) * of_parts + c] = line[i];
    }
    load(d->next.depth + pixel, &job->frame.depth, 0, y, x0, n);
}

/* A colour of a part of the light, blended. */
static void finish_part(const Job *job, int part, int channel, const float *restrict filtered, int y, int x0, int n)
{
    const float *restrict alpha = row_line(job->d, y, ALPHA_LINE) + x0;
    const float *restrict importance = row_line(job->d, y, LEVEL_LINES + 3 * LEVELS - 1) + x0;
    float *restrict output = part_line(job->d, y, part, PART_OUTPUT + channel) + x0;
    for (int i = 0; i < n; i++)
        output[i] = importance[i] > NO_WEIGHT ? output[i] + alpha[i] * (filtered[i] - output[i]) : 0;
}

/* A chunk of the last level: its output, divided by the mass, is blended into that of the previous frame. */
static void finish_chunk(Job *job, const Scratch *scratch, int turn, int y, int x0, int n)
{
    const onespp *d = job->d;
    float filtered[MAX_FILTERED][LINE], *to[MAX_FILTERED], scale[LINE];
    const float *restrict alpha = row_line(d, y, ALPHA_LINE) + x0;
    const float *restrict importance = row_line(d, y, LEVEL_LINES + 3 * LEVELS - 1) + x0;
    for (int c = 0; c < MAX_FILTERED; c++)
        to[c] = filtered[c];
    filter_chunk(job, scratch, turn, to, y, x0, n);
    for (int i = 0; i < n; i++)
        scale[i] = 1 / maxf(filtered[MASS][i], MIN_MASS);
    for (int c = 0; c < filtered_channels(job); c++)
        for (int i = 0; i < n; i++)
            filtered[c][i] *= scale[i];
    for (int c = 0; c < RGB; c++) {
        float *restrict output = row_line(d, y, OUTPUT_LINES + c) + x0;
        for (int i = 0; i < n; i++) {
            float blended = output[i] + alpha[i] * (filtered[c][i] - output[i]);
            output[i] = importance[i] > NO_WEIGHT ? blended : 0;
        }
    }
    for (int c = 0; c < RGB * job->frame.parts; c++)
        finish_part(job, c / RGB, c % RGB, filtered[FILTERED + c], y, x0, n);
    remember(job, y, x0, n);
}

static void finish_rows(Job *job, Scratch *scratch, int first, int last)
{
    filter_in_order(job, scratch, first, last, finish_chunk);
}

/* --- The filter, pass by pass ------------------------------------------------------------------------------------ */

static void run_filter(Job *job)
{
    int height = job->frame.height;
    job->pass = -1;
    run(job, split_rows, 0, height);
    for (job->pass = 0; job->pass < PASSES; job->pass++) {
        if (job->pass >= FIRST_GUIDED)
            run(job, guide_rows, 0, height);
        run(job, job->pass < PASSES - 1 ? filter_rows : finish_rows, 0, height);
        if (job->pass == SPREADING - 1)
            run(job, split_rows, 0, height);
    }
}

/* --- Coarse corrections: neighbourhoods get the mean that their samples have -------------------------------------- */

/* Adds n pixels of a row, from the first of a tile on, to the comparisons of the tiles that they lie in. */
static void compare_row(const Job *job, int y, int x0, int n, Comparison *comparisons)
{
    const onespp *d = job->d;
    float noisy[RGB][LINE], light[LINE], residual[LINE], motion[2][LINE];
    const float *output = row_line(d, y, OUTPUT_LINES) + x0;
    const float *importance = row_line(d, y, LEVEL_LINES + 3 * LEVELS - 1) + x0;
    for (int c = 0; c < RGB; c++)
        load_irradiance(noisy[c], &job->frame, c, y, x0, n);
    for (int c = 0; c < 2; c++)
        load(motion[c], &job->frame.motion, c, y, x0, n);
    for (int i = 0; i < n; i++) {
        float sample = luminance(noisy[0][i], noisy[1][i], noisy[2][i]);
        float denoised = luminance(output[i], output[d->pitch + i], output[2 * d->pitch + i]);
        sample = minf(maxf(job->exposure * sample, 0), MAX_EXPOSED);
        denoised = minf(maxf(job->exposure * denoised, 0), MAX_EXPOSED);
        residual[i] = (sample - denoised) / (denoised + COARSE_DARK);
        light[i] = denoised / (denoised + COARSE_DARK);
    }
    for (int i = 0; i < n; i++) {
        Comparison *tile = comparisons + i / TILE;
        float surface = importance[i] > NO_WEIGHT ? 1.f : 0.f;
        tile->residual += surface * residual[i];
        tile->square += surface * residual[i] * residual[i];
        tile->light += surface * light[i];
        tile->motion[0] += surface * motion[0][i];
        tile->motion[1] += surface * motion[1][i];
        tile->pixels += surface;
    }
}

/* The rows are those of tiles. */
static void compare_rows(Job *job, Scratch *scratch, int first, int last)
{
    (void)scratch;
    int columns = tiles_along(job->frame.width);
    for (int row = first; row < last; row++) {
        Comparison *comparisons = job->d->comparisons + (ptrdiff_t)row * columns;
        memset(comparisons, 0, sizeof *comparisons * (size_t)columns);
        for (int y = row * TILE; y < mini((row + 1) * TILE, job->frame.height); y++)
            for (int x0 = 0; x0 < job->frame.width; x0 += CHUNK)
                compare_row(job, y, x0, mini(CHUNK, job->frame.width - x0), comparisons + x0 / TILE);
    }
}

/* The residual at a place between tiles, which is inside. */
static Residual residual_at(const Residual *residuals, float x, float y, int columns, int rows)
{
    int left = (int)x, top = (int)y, right = mini(left + 1, columns - 1), bottom = mini(top + 1, rows - 1);
    float fx = x - (float)left, fy = y - (float)top;
    float weights[4] = {(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy};
    Residual mean = {0, 0, 0};
    for (int tap = 0; tap < 4; tap++) {
        const Residual *there = residuals + (ptrdiff_t)(tap / 2 ? bottom : top) * columns + (tap % 2 ? right : left);
        mean.sum += weights[tap] * there->sum;
        mean.variance += weights[tap] * there->variance;
        mean.length += weights[tap] * there->length;
    }
    return mean;
}

/* The mean of a tile's residual over the last frames, of which the past ones are where the tile's motion leads. */
static Residual average(const Job *job, int x, int y, int columns, int rows)
{
    const Comparison *now = job->d->comparisons + (ptrdiff_t)y * columns + x;
    Residual mean = {now->residual, now->square, 1};
    float pixels = TILE * maxf(now->pixels, 1);
    float then_x = (float)x + now->motion[0] / pixels, then_y = (float)y + now->motion[1] / pixels;
    int is_inside = then_x >= -0.5f && then_x <= (float)columns - 0.5f && then_y >= -0.5f && then_y <= (float)rows - 0.5f;
    if (!job->has_history || !is_inside)
        return mean;
    then_x = maxf(minf(then_x, (float)(columns - 1)), 0);
    then_y = maxf(minf(then_y, (float)(rows - 1)), 0);
    Residual past = residual_at(job->d->past.residuals, then_x, then_y, columns, rows);
    mean.length = minf(past.length + 1, COARSE_LENGTH);
    float newest = 1 / mean.length, kept = 1 - newest;
    mean.sum = past.sum + newest * (now->residual - past.sum);
    mean.variance = kept * kept * past.variance + newest * newest * now->square;
    return mean;
}

/* What the tiles' light is multiplied by, in two steps; narrow neighbourhoods see what the wide ones leave. Tiles count by
 * the frames that they know. */
static void find_corrections(const Job *job)
{
    onespp *d = job->d;
    int columns = tiles_along(job->frame.width), rows = tiles_along(job->frame.height), count = columns * rows;
    static const int deviations[2] = {WIDE_DEVIATION, NARROW_DEVIATION};
    for (int i = 0; i < count; i++) {
        d->residuals[i] = average(job, i % columns, i / columns, columns, rows);
        d->comparisons[i].gain = 1;
    }
    memcpy(d->next.residuals, d->residuals, sizeof(Residual) * (size_t)count);
    for (int step = 0; step < 2; step++) {
        for (int i = 0; i < count; i++) {
            float gain = d->comparisons[i].gain, light = d->comparisons[i].light;
            Residual known = d->residuals[i];
            d->tiles[i].past = known.length * gain * light;
            d->tiles[i].change = known.length * (known.sum - (gain - 1) * light);
            d->tiles[i].variance = known.length * known.length * known.variance;
        }
        find_gains(d->tiles, d->row_tiles, rows, columns, deviations[step], COARSE_NOISE, COARSE_LEAST);
        for (int i = 0; i < count; i++)
            d->tiles[i].gain = d->comparisons[i].gain *= d->tiles[i].gain;
    }
}

/* --- Output ------------------------------------------------------------------------------------------------------- */

/* One colour of the denoised radiance. */
static void write_radiance(const Job *job, int channel, const float *restrict gain, int y, int x0, int n)
{
    float divisor[LINE], emission[LINE];
    const float *restrict output = row_line(job->d, y, OUTPUT_LINES + channel) + x0;
    load_divisor(divisor, &job->frame, channel, y, x0, n);
    load(emission, &job->frame.emission, channel, y, x0, n);
    ptrdiff_t step = job->radiance.column;
    float *to = job->radiance.data + job->radiance.channel * channel + job->radiance.row * y + step * x0;
    for (int i = 0; i < n; i++)
        to[i * step] = gain[i] * output[i] * divisor[i] + emission[i];
}

/* A colour of a part of the light: where no surface is, it stays as it is. */
static void write_part(const Job *job, int part, int channel, const float *restrict gain, int y, int x0, int n)
{
    float divisor[LINE], noisy[LINE];
    int is_light = part < job->frame.parts - job->frame.masks;
    const float *restrict importance = row_line(job->d, y, LEVEL_LINES + 3 * LEVELS - 1) + x0;
    const float *restrict output = part_line(job->d, y, part, PART_OUTPUT + channel) + x0;
    const onespp_output *image = &job->frame.part[part].radiance;
    float *to = image->data + image->channel * channel + image->row * y + image->column * x0;
    load_divisor(divisor, &job->frame, channel, y, x0, n);
    load(noisy, &job->frame.part[part].noisy, channel, y, x0, n);
    for (int i = 0; i < n; i++) {
        float light = (is_light ? gain[i] : 1) * output[i] * divisor[i];
        to[i * image->column] = importance[i] > NO_WEIGHT ? light : noisy[i];
    }
}

static void write_rows(Job *job, Scratch *scratch, int first, int last)
{
    (void)scratch;
    float gain[LINE];
    for (int y = first; y < last; y++)
        for (int x0 = 0; x0 < job->frame.width; x0 += CHUNK) {
            int n = mini(CHUNK, job->frame.width - x0);
            interpolate_gain(gain, job, job->d->tiles, TILE, y, x0, n);
            for (int c = 0; c < RGB; c++)
                write_radiance(job, c, gain, y, x0, n);
            for (int c = 0; c < RGB * job->frame.parts; c++)
                write_part(job, c / RGB, c % RGB, gain, y, x0, n);
        }
}

/* --- The engine --------------------------------------------------------------------------------------------------- */

static uint64_t measure_memory(const onespp_config *config)
{
    onespp measured;
    Arena arena = {NULL, 0};
    measured.config = *config;
    allocate(&arena, 1, sizeof(onespp));
    lay_out(&measured, &arena);
    return arena.used + ALIGNMENT; /* the caller's memory may begin anywhere */
}

static onespp *create(const onespp_config *config, void *memory, const Weights *weights)
{
    unsigned char *base = memory;
    Arena arena = {base + (ALIGNMENT - (uintptr_t)base % ALIGNMENT) % ALIGNMENT, 0};
    onespp *d = allocate(&arena, 1, sizeof(onespp));
    d->config = *config;
    lay_out(d, &arena);
    /* There is no previous frame, whatever the memory held. */
    memset(d->own_history, 0, sizeof(Moment));
    memset(d->zeros, 0, sizeof(float) * (size_t)d->a.pitch);
    /* Distances of taps beside the image are never measured, but read; such taps have no weight. */
    memset(d->distances, 0, sizeof(float) * (size_t)count_distances(config));
    for (ptrdiff_t i = 0; i < d->pitch; i++)
        d->ones[i] = 1;
    float *to = d->parameters;
    ptrdiff_t from = 0;
    for (int i = 0; i < LAYERS; i++) {
        from = unpack(&d->layers[i], i, to, weights, from);
        to += parameters_of(&d->layers[i], i);
    }
    return d;
}

static int check(const onespp *d, const onespp_frame *frame, const onespp_output *radiance)
{
    int fits = frame->width >= 1 && frame->width <= d->config.max_width && frame->height >= 1
        && frame->height <= d->config.max_height && frame->meshes >= 0 && frame->meshes <= d->config.max_meshes;
    int complete = frame->direct.data && frame->albedo.data && frame->normal.data && frame->depth.data
        && frame->motion.data && radiance->data && (frame->meshes == 0 || frame->object_to_world);
    complete = complete && frame->parts >= 0 && frame->parts <= d->config.max_parts && (frame->parts == 0 || frame->part)
        && frame->masks >= 0 && frame->masks <= frame->parts;
    for (int i = 0; complete && i < frame->parts; i++)
        complete = frame->part[i].noisy.data && frame->part[i].radiance.data;
    if (!fits || !complete || !(frame->samples >= ONESPP_MIN_SAMPLES && frame->samples <= ONESPP_MAX_SAMPLES))
        return ONESPP_BAD_FRAME;
    for (int i = 0; i < 16; i++)
        if (!isfinite(frame->camera_to_world[i]) || (i < 9 && !isfinite(frame->K[i])))
            return ONESPP_BAD_CAMERA;
    return frame->K[0] == 0 || frame->K[4] == 0 ? ONESPP_BAD_CAMERA : ONESPP_OK;
}

/* A value in all pixels, where an optional image is missing. */
static void set_default(onespp_image *image, const float *value)
{
    onespp_image constant = {value, 0, 0, 0};
    if (!image->data)
        *image = constant;
}

/* Keeps what the next frame needs to know of this one, beside its images. */
static void remember_moment(const onespp *d, const onespp_frame *frame)
{
    Moment *moment = d->next.moment;
    moment->width = frame->width;
    moment->height = frame->height;
    moment->meshes = frame->meshes;
    moment->parts = frame->parts;
    memcpy(moment->K, frame->K, sizeof moment->K);
    memcpy(moment->camera_to_world, frame->camera_to_world, sizeof moment->camera_to_world);
    if (frame->meshes)
        memcpy(d->next.object_to_world, frame->object_to_world, sizeof(double) * 16 * (size_t)frame->meshes);
}

/* Whether the frame continues the sequence that the past is of. */
static int continues(const onespp_frame *frame, const Moment *past)
{
    return past && !frame->reset && frame->width == past->width && frame->height == past->height
        && frame->parts == past->parts;
}

static int denoise(onespp *d, void *past, void *next, const onespp_frame *frame, const onespp_output *radiance)
{
    static const float zero = 0, one = 1;
    int error = check(d, frame, radiance);
    if (error)
        return error;
    Arena past_arena = {past, 0}, next_arena = {next, 0};
    d->past = lay_out_history(&d->config, &past_arena);
    d->next = lay_out_history(&d->config, &next_arena);
    Job job = {.d = d, .frame = *frame, .radiance = *radiance};
    job.padded_width = rounded_up(frame->width, 8);
    job.padded_height = rounded_up(frame->height, 8);
    job.has_history = continues(frame, d->past.moment);
    set_default(&job.frame.indirect, &zero);
    set_default(&job.frame.emission, &zero);
    set_default(&job.frame.roughness, &one);
    measure(&job);
    set_up_geometry(&job);
    int rows = blocks_along(frame->height), columns = blocks_along(frame->width);
    run(&job, reproject_rows, 0, rows);
    if (job.has_history) {
        find_gains(d->changes, d->row_changes, rows, columns, GAIN_DEVIATION, GAIN_NOISE, 1 / MAX_GAIN);
        run(&job, follow_rows, 0, frame->height);
    }
    run_network(&job);
    run_filter(&job);
    run(&job, compare_rows, 0, tiles_along(frame->height));
    find_corrections(&job);
    run(&job, write_rows, 0, frame->height);
    remember_moment(d, frame);
    return ONESPP_OK;
}

/* The engines are no part of the interface of a shared library. On Windows nothing is exported by itself. */
#if defined(_WIN32)
#define HIDDEN
#else
#define HIDDEN __attribute__((visibility("hidden")))
#endif

#if defined(ONESPP_AVX512)

HIDDEN const Engine onespp_avx512 = {ONESPP_ISA_AVX512, measure_memory, create, denoise};

#elif defined(ONESPP_AVX2)

HIDDEN const Engine onespp_avx2 = {ONESPP_ISA_AVX2, measure_memory, create, denoise};

#else

/* --- The interface ------------------------------------------------------------------------------------------------ */

static const Engine baseline = {ONESPP_ISA_BASELINE, measure_memory, create, denoise};

/* Flags for AVX-512 leave no choice. GCC for Windows does not align the stack for AVX (its bug 54412). */
#if defined(ONESPP_DISPATCH) && defined(__x86_64__) && defined(__GNUC__) && !defined(_WIN32) && !defined(__AVX512F__)

extern HIDDEN const Engine onespp_avx2, onespp_avx512;

/* The fastest engine for this processor and operating system. */
static const Engine *engine_of(const onespp_config *config)
{
    int most = config->max_isa == ONESPP_ISA_ANY ? ONESPP_ISA_AVX512 : config->max_isa;
    int has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    int has_avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw")
        && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
    if (most >= ONESPP_ISA_AVX512 && has_avx2 && has_avx512)
        return &onespp_avx512;
    return most >= ONESPP_ISA_AVX2 && has_avx2 ? &onespp_avx2 : &baseline;
}

#else

static const Engine *engine_of(const onespp_config *config)
{
    (void)config;
    return &baseline;
}

#endif

int onespp_abi(void) { return ONESPP_ABI; }

int onespp_isa(const onespp *denoiser) { return denoiser->engine->isa; }

const char *onespp_message(int code)
{
    static const char *const messages[] = {
        "no error",
        "compiled with another version of onespp.h",
        "a size or number of tasks is out of range",
        "the memory is missing, too small or not aligned",
        "a size, a number of samples or an image is missing or out of range",
        "a camera is not finite, or its focal length is 0",
    };
    return code >= 0 && code < (int)(sizeof messages / sizeof *messages) ? messages[code] : "unknown error";
}

static int is_valid(const onespp_config *config)
{
    return config->max_width >= 1 && config->max_width <= ONESPP_MAX_SIDE && config->max_height >= 1
        && config->max_height <= ONESPP_MAX_SIDE && config->max_meshes >= 0 && config->max_meshes <= ONESPP_MAX_MESHES
        && config->tasks >= 1 && config->tasks <= ONESPP_MAX_TASKS && config->max_isa >= ONESPP_ISA_ANY
        && config->max_isa <= ONESPP_ISA_AVX512 && config->max_parts >= 0 && config->max_parts <= ONESPP_MAX_PARTS;
}

static size_t checked_size(uint64_t size) { return size <= SIZE_MAX / 2 ? (size_t)size : 0; }

size_t onespp_size(const onespp_config *config)
{
    if (config->abi != ONESPP_ABI || !is_valid(config))
        return 0;
    return checked_size(engine_of(config)->measure(config));
}

size_t onespp_history_size(const onespp_config *config)
{
    return onespp_size(config) ? checked_size(measure_history(config)) : 0;
}

static int create_with(const onespp_config *config, void *memory, size_t size, const Weights *weights, onespp **denoiser)
{
    if (config->abi != ONESPP_ABI)
        return ONESPP_BAD_ABI;
    size_t needed = onespp_size(config);
    if (needed == 0)
        return ONESPP_BAD_CONFIG;
    if (!memory || size < needed)
        return ONESPP_BAD_MEMORY;
    const Engine *engine = engine_of(config);
    *denoiser = engine->create(config, memory, weights);
    (*denoiser)->engine = engine;
    return ONESPP_OK;
}

int onespp_create(const onespp_config *config, void *memory, size_t size, onespp **denoiser)
{
    Weights weights = {onespp_weights, NULL};
    return create_with(config, memory, size, &weights, denoiser);
}

int onespp_create_with(
    const onespp_config *config, void *memory, size_t size, const float *weights, size_t count, onespp **denoiser)
{
    Weights given = {NULL, weights};
    if (!weights || count != sizeof onespp_weights / sizeof *onespp_weights)
        return ONESPP_BAD_CONFIG;
    return create_with(config, memory, size, &given, denoiser);
}

int onespp_denoise(onespp *denoiser, const onespp_frame *frame, const onespp_output *radiance)
{
    void *history = denoiser->own_history;
    return denoiser->engine->denoise(denoiser, history, history, frame, radiance);
}

int onespp_denoise_from(
    onespp *denoiser, const void *past, void *next, const onespp_frame *frame, const onespp_output *radiance)
{
    if (!next || (uintptr_t)past % ALIGNMENT || (uintptr_t)next % ALIGNMENT)
        return ONESPP_BAD_MEMORY;
    return denoiser->engine->denoise(denoiser, (void *)(uintptr_t)past, next, frame, radiance);
}

void onespp_read_history(const onespp *denoiser, const void *history, const onespp_output *to)
{
    Arena arena = {(void *)(uintptr_t)history, 0};
    History past = lay_out_history(&denoiser->config, &arena);
    for (int y = 0; y < past.moment->height; y++)
        for (int x = 0; x < past.moment->width; x++)
            for (int c = 0; c < ONESPP_HISTORY; c++)
                to->data[to->channel * c + to->row * y + to->column * x]
                    = past.texels[((ptrdiff_t)y * denoiser->pitch + x) * TEXEL + c];
}

#endif
