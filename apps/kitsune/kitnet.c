/* KitNET: an ensemble of small autoencoders, and one more that judges their errors.
 *
 * Both layers have the same shape: `count` autoencoders, padded to `visible` inputs and `hidden`
 * units.  Tied weights, sigmoid units, inputs scaled to 0..1 by the range seen in training.
 */

#include <math.h>
#include <stdint.h>

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define SEVERAL_PROCESSORS
#define INLINE inline __attribute__((always_inline))
#else
#define INLINE inline
#endif

typedef struct {
    int32_t count, visible, hidden;
    const int32_t *visible_of, *hidden_of, *input;
    double *weights, *hidden_bias, *visible_bias, *low, *high;
} Layer;

static double sigmoid(double x)
{
    return 1.0 / (1.0 + exp(-x));
}

static double limited(double x, double clip)
{
    return x > clip ? clip : x < -clip ? -clip : x;
}

/* Scales one autoencoder's inputs.  NaN compares false and so never enters the range. */
static void scale(const Layer *layer, int a, const double *input, double clip, double *x)
{
    const double *low = layer->low + (long)a * layer->visible, *high = layer->high + (long)a * layer->visible;
    for (int v = 0; v < layer->visible_of[a]; v++) {
        x[v] = (input[layer->input[(long)a * layer->visible + v]] - low[v]) / (high[v] - low[v] + 1e-16);
        if (clip > 0)
            x[v] = limited(x[v], clip);
    }
}

static void widen(const Layer *layer, int a, const double *input)
{
    double *low = layer->low + (long)a * layer->visible, *high = layer->high + (long)a * layer->visible;
    for (int v = 0; v < layer->visible_of[a]; v++) {
        double value = input[layer->input[(long)a * layer->visible + v]];
        if (value < low[v])
            low[v] = value;
        if (value > high[v])
            high[v] = value;
    }
}

/* Encodes and decodes x; leaves hidden activity in y and x minus its copy in e; returns the RMSE. */
static double reconstruct(const Layer *layer, int a, const double *x, double *y, double *e)
{
    int nv = layer->visible_of[a], nh = layer->hidden_of[a];
    const double *w = layer->weights + (long)a * layer->visible * layer->hidden;
    const double *hb = layer->hidden_bias + (long)a * layer->hidden;
    const double *vb = layer->visible_bias + (long)a * layer->visible;
    for (int h = 0; h < nh; h++)
        y[h] = 0;
    for (int v = 0; v < nv; v++)
        for (int h = 0; h < nh; h++)
            y[h] += x[v] * w[v * layer->hidden + h];
    for (int h = 0; h < nh; h++)
        y[h] = sigmoid(y[h] + hb[h]);
    double total = 0;
    for (int v = 0; v < nv; v++) {
        double z = 0;
        for (int h = 0; h < nh; h++)
            z += y[h] * w[v * layer->hidden + h];
        e[v] = x[v] - sigmoid(z + vb[v]);
        total += e[v] * e[v];
    }
    return sqrt(total / nv);
}

static void descend(Layer *layer, int a, double rate, const double *x, const double *y, const double *e, double *g)
{
    int nv = layer->visible_of[a], nh = layer->hidden_of[a];
    double *w = layer->weights + (long)a * layer->visible * layer->hidden;
    double *hb = layer->hidden_bias + (long)a * layer->hidden, *vb = layer->visible_bias + (long)a * layer->visible;
    for (int h = 0; h < nh; h++)
        g[h] = 0;
    for (int v = 0; v < nv; v++)
        for (int h = 0; h < nh; h++)
            g[h] += e[v] * w[v * layer->hidden + h];
    for (int h = 0; h < nh; h++)
        g[h] *= y[h] * (1 - y[h]);
    for (int v = 0; v < nv; v++) {
        for (int h = 0; h < nh; h++)
            w[v * layer->hidden + h] += rate * (x[v] * g[h] + e[v] * y[h]);
        vb[v] += rate * e[v];
    }
    for (int h = 0; h < nh; h++)
        hb[h] += rate * g[h];
}

static void train_layer(Layer *layer, const double *input, double rate, double *scratch, double *errors)
{
    double *x = scratch, *e = x + layer->visible, *y = e + layer->visible, *g = y + layer->hidden;
    for (int a = 0; a < layer->count; a++) {
        widen(layer, a, input);
        scale(layer, a, input, 0, x);
        errors[a] = reconstruct(layer, a, x, y, e);
        descend(layer, a, rate, x, y, e, g);
    }
}

/* Whether no index of the layer leaves its arrays, or a row of `width` numbers. */
static int is_sound(const Layer *layer, long width)
{
    if (layer->count < 1 || layer->visible < 1 || layer->hidden < 1)
        return 0;
    for (int a = 0; a < layer->count; a++) {
        if (layer->visible_of[a] < 0 || layer->visible_of[a] > layer->visible)
            return 0;
        if (layer->hidden_of[a] < 0 || layer->hidden_of[a] > layer->hidden)
            return 0;
        for (int v = 0; v < layer->visible_of[a]; v++) {
            int32_t at = layer->input[(long)a * layer->visible + v];
            if (at < 0 || at >= width)
                return 0;
        }
    }
    return 1;
}

static int are_sound(const Layer *ensemble, const Layer *output, long n, long width)
{
    return n >= 0 && is_sound(ensemble, width) && output->count == 1 && is_sound(output, ensemble->count);
}

/* One pass of gradient descent over n rows, in order; scratch: ensemble count + 2 * (visible + hidden).
 * -2, and nothing done, for layers that do not fit each other or the rows. */
int kitnet_train(Layer *ensemble, Layer *output, const double *x, long n, long width, double rate, double *scratch)
{
    if (!are_sound(ensemble, output, n, width))
        return -2;
    double error, *errors = scratch + 2 * (output->visible + output->hidden + ensemble->visible + ensemble->hidden);
    for (long i = 0; i < n; i++) {
        train_layer(ensemble, x + i * width, rate, scratch, errors);
        train_layer(output, errors, rate, scratch, &error);
    }
    return 0;
}

/* ---- scoring: LANES packets at a time, so that the compiler can use vector registers ---- */

#define LANES 16
#define EACH_LANE(l) for (int l = 0; l < LANES; l++)

/* e^x for |x| <= 708, error below 2 units in the last place: Cody-Waite reduction, then a polynomial
 * of degree 13.  Unlike libm's it is inlined and works on a whole vector of packets. */
static INLINE double exponential(double x)
{
    static const double ROUND = 6755399441055744.0; /* 1.5 * 2^52: adding it rounds to an integer */
    double shifted = x * 1.4426950408889634 + ROUND, n = shifted - ROUND;
    double r = x - n * 6.93147180369123816490e-01 - n * 1.90821492927058770002e-10;
    double p = 1.6059043836821613e-10;
    p = p * r + 2.0876756987868099e-09;
    p = p * r + 2.5052108385441720e-08;
    p = p * r + 2.7557319223985893e-07;
    p = p * r + 2.7557319223985888e-06;
    p = p * r + 2.4801587301587302e-05;
    p = p * r + 1.9841269841269841e-04;
    p = p * r + 1.3888888888888889e-03;
    p = p * r + 8.3333333333333332e-03;
    p = p * r + 4.1666666666666664e-02;
    p = p * r + 1.6666666666666666e-01;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    union {
        double d;
        uint64_t u;
    } bits = {shifted}, scale;
    scale.u = (bits.u + 1023) << 52; /* the integer sits in the low bits of `shifted` */
    return p * scale.d;
}

static INLINE double sigmoid_fast(double x)
{
    /* beyond these limits the result is 0 or 1 to the last bit; NaN passes through */
    double limited = x < -700.0 ? -700.0 : x;
    limited = limited > 700.0 ? 700.0 : limited;
    return 1.0 / (1.0 + exponential(-limited));
}

static void load(const Layer *layer, int a, const double *rows, long stride, double clip, double x[][LANES])
{
    long first = (long)a * layer->visible;
    for (int v = 0; v < layer->visible_of[a]; v++) {
        const double *column = rows + layer->input[first + v];
        double low = layer->low[first + v], range = layer->high[first + v] - low + 1e-16;
        EACH_LANE(l) x[v][l] = (column[l * stride] - low) / range;
        if (clip > 0)
            EACH_LANE(l) x[v][l] = limited(x[v][l], clip);
    }
}

/* Weighted sums of two units at a time: each input is loaded once for both, and the sums do not wait for each other. */
static INLINE void weigh_two(double in[][LANES], int n, const double *w, long step, long apart, double *first, double *second)
{
    EACH_LANE(l) first[l] = second[l] = 0;
    for (int i = 0; i < n; i++) {
        double a = w[i * step], b = w[i * step + apart];
        EACH_LANE(l) first[l] += in[i][l] * a;
        EACH_LANE(l) second[l] += in[i][l] * b;
    }
}

static INLINE void add_errors(const double *x, const double *sum, double bias, double *total)
{
    EACH_LANE(l)
    {
        double e = x[l] - sigmoid_fast(sum[l] + bias);
        total[l] += e * e;
    }
}

static INLINE void rmse_body(const Layer *layer, int a, double x[][LANES], double y[][LANES], double *out, long stride)
{
    int nv = layer->visible_of[a], nh = layer->hidden_of[a];
    long width = layer->hidden;
    const double *w = layer->weights + (long)a * layer->visible * width;
    const double *hb = layer->hidden_bias + (long)a * width;
    const double *vb = layer->visible_bias + (long)a * layer->visible;
    double first[LANES], second[LANES], total[LANES] = {0};
    for (int h = 0; h < nh; h += 2) {
        int has_two = h + 1 < nh;
        weigh_two(x, nv, w + h, width, has_two, first, second);
        EACH_LANE(l) y[h][l] = sigmoid_fast(first[l] + hb[h]);
        if (has_two)
            EACH_LANE(l) y[h + 1][l] = sigmoid_fast(second[l] + hb[h + 1]);
    }
    for (int v = 0; v < nv; v += 2) {
        int has_two = v + 1 < nv;
        weigh_two(y, nh, w + v * width, 1, has_two ? width : 0, first, second);
        add_errors(x[v], first, vb[v], total);
        if (has_two)
            add_errors(x[v + 1], second, vb[v + 1], total);
    }
    EACH_LANE(l) out[l * stride] = sqrt(total[l] / nv);
}

typedef void Rmse(const Layer *, int, double[][LANES], double[][LANES], double *, long);

#define RMSE(name) static void name(const Layer *layer, int a, double x[][LANES], double y[][LANES], double *out, long stride) { rmse_body(layer, a, x, y, out, stride); }

#ifdef SEVERAL_PROCESSORS
/* fused multiplication and addition: scores differ from the reference by less than 1e-12 */
__attribute__((target("avx512f"), optimize("O3", "fp-contract=fast"))) RMSE(rmse_avx512)
__attribute__((target("avx2,fma"), optimize("O3", "fp-contract=fast"))) RMSE(rmse_avx2)
__attribute__((optimize("O3"))) RMSE(rmse_any)

/* The copy for the widest vectors that the processor has. */
static Rmse *rmse_lanes(void)
{
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f"))
        return rmse_avx512;
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? rmse_avx2 : rmse_any;
}

const char *kitnet_vectors(void)
{
    return rmse_lanes() == rmse_avx512 ? "AVX-512" : rmse_lanes() == rmse_avx2 ? "AVX2" : "none";
}
#else
RMSE(rmse_any)

static Rmse *rmse_lanes(void)
{
    return rmse_any;
}

const char *kitnet_vectors(void)
{
    return "the compiler's";
}
#endif

/* RMSE of each autoencoder and of the output layer for n rows, a multiple of LANES; clip > 0 limits scaled
 * inputs.  Scratch: LANES * (visible + hidden) of the wider layer.  -2 as in `kitnet_train`. */
int kitnet_score(const Layer *ensemble, const Layer *output, const double *x, long n, long width, double clip,
                  double *scratch, double *errors, double *scores)
{
    if (!are_sound(ensemble, output, n, width) || n % LANES)
        return -2;
    Rmse *rmse = rmse_lanes();
    int visible = ensemble->visible > output->visible ? ensemble->visible : output->visible;
    double(*lanes)[LANES] = (double(*)[LANES])scratch, (*hidden)[LANES] = lanes + visible;
    for (long i = 0; i < n; i += LANES) {
        double *row_errors = errors + i * ensemble->count;
        for (int a = 0; a < ensemble->count; a++) {
            load(ensemble, a, x + i * width, width, clip, lanes);
            rmse(ensemble, a, lanes, hidden, row_errors + a, ensemble->count);
        }
        load(output, 0, row_errors, ensemble->count, clip, lanes);
        rmse(output, 0, lanes, hidden, scores + i, 1);
    }
    return 0;
}

/* ---- which of it moved most */

static int is_more(double a, double b)
{
    return a > b || (b != b && a == a);
}

/* The input that is farthest from the middle of its range; the first that is no number, if there is one. */
static int32_t farthest_input(const Layer *layer, int a, const double *row)
{
    long first = (long)a * layer->visible;
    int32_t found = -1;
    double most = -1;
    for (int v = 0; v < layer->visible_of[a]; v++) {
        double low = layer->low[first + v], x = row[layer->input[first + v]];
        double moved = fabs((x - low) / (layer->high[first + v] - low + 1e-16) - 0.5);
        if (moved != moved)
            return layer->input[first + v];
        if (moved > most) {
            most = moved;
            found = layer->input[first + v];
        }
    }
    return found;
}

/* For n rows of x: the two autoencoders with the highest errors, compared with those of training, and the input of each
 * that moved most; -1 where there is no second.  Errors are those of the rows from `first` on.  -2 as in `kitnet_train`. */
int kitnet_moved(const Layer *ensemble, const Layer *output, const double *x, long width, const double *errors, long first,
                 const int32_t *rows, long n, int32_t *out)
{
    if (!are_sound(ensemble, output, n, width) || output->visible < ensemble->count)
        return -2;
    for (long i = 0; i < n; i++, out += 4) {
        const double *row = x + rows[i] * width, *error = errors + (rows[i] - first) * ensemble->count;
        double excess[2] = {NAN, NAN};
        out[0] = out[1] = out[2] = out[3] = -1;
        for (int32_t a = 0; a < ensemble->count; a++) {
            double more = (error[a] - output->low[a]) / (output->high[a] - output->low[a] + 1e-16);
            if (out[0] < 0 || is_more(more, excess[0])) {
                excess[1] = excess[0];
                out[1] = out[0];
                excess[0] = more;
                out[0] = a;
            } else if (out[1] < 0 || is_more(more, excess[1])) {
                excess[1] = more;
                out[1] = a;
            }
        }
        for (int which = 0; which < 2 && out[which] >= 0; which++)
            out[2 + which] = farthest_input(ensemble, out[which], row);
    }
    return 0;
}
