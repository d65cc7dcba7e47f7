/* KitNET: an ensemble of small autoencoders, and one more that judges their errors.
 *
 * Both layers have the same shape: `count` autoencoders, padded to `visible` inputs and `hidden`
 * units.  Tied weights, sigmoid units, inputs scaled to 0..1 by the range seen in training.
 */

#include <math.h>
#include <stdint.h>

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

/* One pass of gradient descent over n rows, in order; scratch: ensemble count + 2 * (visible + hidden). */
void kitnet_train(Layer *ensemble, Layer *output, const double *x, long n, long width, double rate, double *scratch)
{
    double error, *errors = scratch + 2 * (output->visible + output->hidden + ensemble->visible + ensemble->hidden);
    for (long i = 0; i < n; i++) {
        train_layer(ensemble, x + i * width, rate, scratch, errors);
        train_layer(output, errors, rate, scratch, &error);
    }
}

/* RMSE of each autoencoder and of the output layer for n rows; clip > 0 limits scaled inputs. */
void kitnet_score(const Layer *ensemble, const Layer *output, const double *x, long n, long width, double clip,
                  double *scratch, double *errors, double *scores)
{
    for (long i = 0; i < n; i++, errors += ensemble->count) {
        double *scaled = scratch, *e, *y;
        e = scaled + ensemble->visible + output->visible;
        y = e + ensemble->visible + output->visible;
        for (int a = 0; a < ensemble->count; a++) {
            scale(ensemble, a, x + i * width, clip, scaled);
            errors[a] = reconstruct(ensemble, a, scaled, y, e);
        }
        scale(output, 0, errors, clip, scaled);
        scores[i] = reconstruct(output, 0, scaled, y, e);
    }
}
