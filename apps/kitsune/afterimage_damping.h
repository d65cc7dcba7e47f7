/* The damped sums of streams and links, in the published order of operations. */

#ifndef AFTERIMAGE_DAMPING_H
#define AFTERIMAGE_DAMPING_H

#include <math.h>

#include "afterimage_state.h"

static const double LAMBDA[SCALES] = {5, 3, 1, 0.1, 0.01};

static const double *factors(AfterImage *self, double dt)
{
    uint64_t bits;
    memcpy(&bits, &dt, 8);
    Memo *memo = &self->memo[mix(bits) % MEMO_SLOTS];
    if (memo->dt != dt) {
        memo->dt = dt;
        EACH_SCALE(k) memo->factor[k] = pow(2, -LAMBDA[k] * dt);
    }
    return memo->factor;
}

/* As `factors`; `event` is the packet that is replayed, or NULL. */
static const double *factors_at(AfterImage *self, double dt, const Event *event)
{
    return event && event->since == dt ? event->factor : factors(self, dt);
}

static void decay_stream_at(AfterImage *self, Stream *s, double t, const Event *event)
{
    double dt = t - s->last;
    if (!(dt > 0))
        return;
    s->last = t;
    if (!s->packets) /* nothing to damp yet: 1e-20 + 1 is 1 at any age */
        return;
    const double *f = factors_at(self, dt, event);
    EACH_SCALE(k)
    {
        s->cf1[k] *= f[k];
        s->cf2[k] *= f[k];
        s->w[k] *= f[k];
    }
}

static void decay_stream(AfterImage *self, Stream *s, double t)
{
    decay_stream_at(self, s, t, NULL);
}

static void decay_link(AfterImage *self, Link *link, double t, const Event *event)
{
    double dt = t - link->last;
    if (!(dt > 0))
        return;
    link->last = t;
    const double *f = factors_at(self, dt, event);
    EACH_SCALE(k)
    {
        link->cf3[k] *= f[k];
        link->w3[k] *= f[k];
    }
}

static void update_link_at(AfterImage *self, Link *link, int side, const double *residual, double t, const Event *event)
{
    decay_link(self, link, t, event);
    double *other = link->residual[!side];
    EACH_SCALE(k)
    {
        link->cf3[k] += residual[k] * other[k];
        link->w3[k] += 1;
        link->residual[side][k] = residual[k];
    }
}

static void update_link(AfterImage *self, Link *link, int side, const double *residual, double t)
{
    update_link_at(self, link, side, residual, t, NULL);
}

static void insert(AfterImage *self, Stream *s, double v, double t)
{
    decay_stream(self, s, t);
    double square = pow(v, 2);
    EACH_SCALE(k)
    {
        s->cf1[k] += v;
        s->cf2[k] += square;
        s->w[k] += 1;
        s->mean[k] = s->cf1[k] / s->w[k];
        s->mean_squared[k] = pow(s->mean[k], 2);
        s->var[k] = fabs(s->cf2[k] / s->w[k] - s->mean_squared[k]);
        s->std[k] = sqrt(s->var[k]);
    }
    s->packets++;
}

#endif
