/* The functions of FMI 2.0 for co-simulation around the compiled physics of eha_monitor.

   The physics itself is in another object file, made by numba from eha_monitor/physics; model.h is
   written for each FMU and holds what its config says. */

#include "model.h"
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED __attribute__((visibility("default")))
#endif

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING } Status;
typedef void Logger(void *environment, const char *instance, Status status, const char *category,
                    const char *message, ...);
typedef struct {
    Logger *logger;
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *environment, Status status);
    void *environment;
} Callbacks;

enum { CIRCUIT, ADVANCE, OUTPUTS, REST };
enum { X_D, SPEED, LOAD, N_INPUTS };
enum { N_OUTPUTS = 9 }; /* x v p1 p2 omega x_measured p1_measured p2_measured force */

/* numba's own calling convention: what it returns, an exception, the arguments; not 0 is an error */
extern int eha_kernel(void *returned, void **exception, int64_t what, double *y, double *theta,
                      double *w, double *memory, double *past, double *u, double *scratch,
                      double *out, const int64_t *terms, int64_t n_terms, const int64_t *updates,
                      int64_t n_updates, const uint8_t *active, int64_t *places, double t,
                      double h, double value, double slope, double load, double load_slope,
                      int64_t n, uint8_t closed);

/* All that a simulation remembers, without a pointer: copied whole as an FMU state. */
typedef struct {
    double y[N_STATE], theta[N_THETA], w[N_CIRCUIT], memory[N_MEMORY], past[RING * 4],
        u[ROWS * 4], scratch[N_SCRATCH], out[N_OUT];
    double input[N_INPUTS], slope[N_INPUTS], x_start, start_time;
    int64_t places[2], steps;
    int32_t closed, running, changed;
} State;

typedef struct {
    State state;
    Callbacks callbacks;
    char *name;
} Instance;

static Status complain(Instance *m, const char *message)
{
    if (m->callbacks.logger)
        m->callbacks.logger(m->callbacks.environment, m->name, ERROR, "logStatusError", "%s",
                            message);
    return ERROR;
}

static int call(State *s, int64_t what, int64_t n)
{
    void *exception = NULL;
    int64_t returned = 0;
    int which = s->closed ? X_D : SPEED;
    return eha_kernel(&returned, &exception, what, s->y, s->theta, s->w, s->memory, s->past, s->u,
                      s->scratch, s->out, TERMS, N_TERMS, UPDATES, N_UPDATES, ACTIVE, s->places,
                      (double)s->steps * STEP, STEP, s->input[which], s->slope[which],
                      s->input[LOAD], s->slope[LOAD], n, s->closed != 0);
}

static void fresh(State *s)
{
    memset(s, 0, sizeof *s);
    memcpy(s->theta, THETA, sizeof s->theta);
    s->x_start = X_START;
    s->input[X_D] = X_START;
    s->closed = CLOSED;
    s->changed = 1;
}

/* At rest at x_start: the pressures hold the load, the past was the same. */
static void at_rest(State *s)
{
    memset(s->memory, 0, sizeof s->memory);
    s->y[0] = s->x_start;
    call(s, REST, 0);
    for (int i = 0; i < RING; i++) {
        s->past[4 * i] = s->x_start;
        s->past[4 * i + 1] = 0.0;
        s->past[4 * i + 2] = s->y[2];
        s->past[4 * i + 3] = s->y[3];
    }
    s->places[0] = s->places[1] = s->steps = 0;
    s->changed = 1;
}

static int refreshed(State *s)
{
    if (!s->changed)
        return 0;
    s->changed = 0;
    return call(s, CIRCUIT, 0) || call(s, OUTPUTS, 0);
}

EXPORTED const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORTED const char *fmi2GetVersion(void) { return "2.0"; }

EXPORTED Status fmi2SetDebugLogging(void *c, int on, size_t n, const char *const categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return OK;
}

EXPORTED void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources,
                               const Callbacks *callbacks, int visible, int logging)
{
    (void)resources, (void)visible, (void)logging;
    if (type != 1 || !guid || strcmp(guid, GUID) != 0)
        return NULL; /* not co-simulation, or the description of another FMU */
    Instance *m = calloc(1, sizeof *m);
    if (!m)
        return NULL;
    if (callbacks)
        m->callbacks = *callbacks;
    m->name = calloc(1, strlen(name ? name : "") + 1);
    if (!m->name) {
        free(m);
        return NULL;
    }
    strcpy(m->name, name ? name : "");
    fresh(&m->state);
    at_rest(&m->state);
    return m;
}

EXPORTED void fmi2FreeInstance(void *c)
{
    Instance *m = c;
    if (m) {
        free(m->name);
        free(m);
    }
}

EXPORTED Status fmi2SetupExperiment(void *c, int tolerant, double tolerance, double start,
                                    int stops, double stop)
{
    (void)tolerant, (void)tolerance, (void)stops, (void)stop;
    ((Instance *)c)->state.start_time = start;
    return OK;
}

EXPORTED Status fmi2EnterInitializationMode(void *c)
{
    at_rest(&((Instance *)c)->state);
    return OK;
}

EXPORTED Status fmi2ExitInitializationMode(void *c)
{
    Instance *m = c;
    at_rest(&m->state);
    m->state.running = 1;
    return refreshed(&m->state) ? complain(m, "the model cannot be started") : OK;
}

EXPORTED Status fmi2Terminate(void *c)
{
    (void)c;
    return OK;
}

EXPORTED Status fmi2Reset(void *c)
{
    State *s = &((Instance *)c)->state;
    fresh(s);
    at_rest(s);
    return OK;
}

static double *place_of(State *s, unsigned int vr)
{
    if (vr < N_INPUTS)
        return &s->input[vr];
    if (vr == VR_X_START)
        return &s->x_start;
    if (vr >= VR_PARAMETER && vr < VR_PARAMETER + N_PARAMETERS)
        return &s->theta[PLACES[vr - VR_PARAMETER]];
    return NULL;
}

EXPORTED Status fmi2GetReal(void *c, const unsigned int vr[], size_t n, double value[])
{
    Instance *m = c;
    State *s = &m->state;
    if (!s->running && s->changed)
        at_rest(s);
    if (refreshed(s))
        return complain(m, "the outputs cannot be calculated");
    for (size_t i = 0; i < n; i++) {
        const double *place = place_of(s, vr[i]);
        if (place)
            value[i] = *place;
        else if (vr[i] >= VR_OUTPUT && vr[i] < VR_OUTPUT + N_OUTPUTS) {
            int which = (int)(vr[i] - VR_OUTPUT);
            double forces = s->theta[AREA_1] * s->y[2] - s->theta[AREA_2] * s->y[3];
            const double shown[N_OUTPUTS] = {s->y[0], s->y[1], s->y[2], s->y[3], s->out[4],
                                             s->out[0], s->out[2], s->out[3], forces};
            value[i] = shown[which];
        } else
            return complain(m, "a value reference that this FMU does not have");
    }
    return OK;
}

EXPORTED Status fmi2SetReal(void *c, const unsigned int vr[], size_t n, const double value[])
{
    Instance *m = c;
    State *s = &m->state;
    for (size_t i = 0; i < n; i++) {
        double *place = place_of(s, vr[i]);
        if (!place)
            return complain(m, "a value reference that this FMU does not have, or cannot be set");
        if (!isfinite(value[i]))
            return complain(m, "a value that is not finite");
        if (vr[i] >= VR_PARAMETER && s->running && !TUNABLE[vr[i] - VR_PARAMETER]
            && *place != value[i])
            return complain(m, "a fixed parameter cannot be set while the simulation runs");
        *place = value[i];
        if (vr[i] < N_INPUTS)
            s->slope[vr[i]] = 0.0;
        s->changed = 1;
    }
    return OK;
}

EXPORTED Status fmi2GetBoolean(void *c, const unsigned int vr[], size_t n, int value[])
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != VR_CLOSED)
            return complain(c, "a value reference that this FMU does not have");
        value[i] = ((Instance *)c)->state.closed;
    }
    return OK;
}

EXPORTED Status fmi2SetBoolean(void *c, const unsigned int vr[], size_t n, const int value[])
{
    State *s = &((Instance *)c)->state;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] != VR_CLOSED)
            return complain(c, "a value reference that this FMU does not have");
        if (s->running || (value[i] && !CLOSED))
            return complain(c, "closed_loop cannot be set now, or the rig has no position_gain");
        s->closed = value[i];
        s->changed = 1;
    }
    return OK;
}

#define NONE(type, name, constant)                                                              \
    EXPORTED Status name(void *c, const unsigned int vr[], size_t n, constant type value[])     \
    {                                                                                           \
        (void)vr, (void)value;                                                                  \
        return n ? complain(c, "this FMU has no variables of that type") : OK;                  \
    }
NONE(int, fmi2GetInteger, )
NONE(int, fmi2SetInteger, const)
NONE(char *, fmi2GetString, const)
NONE(char *, fmi2SetString, const)

EXPORTED Status fmi2SetRealInputDerivatives(void *c, const unsigned int vr[], size_t n,
                                            const int order[], const double value[])
{
    Instance *m = c;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= N_INPUTS || order[i] != 1 || !isfinite(value[i]))
            return complain(m, "expected the finite first derivative of an input");
        m->state.slope[vr[i]] = value[i];
        m->state.changed = 1;
    }
    return OK;
}

EXPORTED Status fmi2GetRealOutputDerivatives(void *c, const unsigned int vr[], size_t n,
                                             const int order[], double value[])
{
    (void)vr, (void)order, (void)value;
    return n ? complain(c, "this FMU gives no derivatives of its outputs") : OK;
}

EXPORTED Status fmi2DoStep(void *c, double now, double length, int keep)
{
    Instance *m = c;
    State *s = &m->state;
    (void)keep;
    if (!s->running)
        return complain(m, "fmi2DoStep before fmi2ExitInitializationMode");
    double wanted = (now + length - s->start_time) / STEP;
    double missing = wanted - (double)s->steps, whole = floor(missing + 0.5);
    if (!(whole >= 0.0 && whole < 1e12) || fabs(missing - whole) > 1e-3) {
        char text[160];
        snprintf(text, sizeof text, "communication points must be whole integration steps of "
                 "%.9g s from the start, got one after %.9g s", STEP, now + length
                 - s->start_time);
        return complain(m, text);
    }
    if (refreshed(s) || call(s, ADVANCE, (int64_t)whole))
        return complain(m, "the integration failed");
    s->steps += (int64_t)whole;
    for (int i = 0; i < N_INPUTS; i++) {
        s->input[i] += s->slope[i] * whole * STEP;
        s->slope[i] = 0.0;
    }
    s->changed = 1;
    for (int i = 0; i < 4; i++)
        if (!isfinite(s->y[i]))
            return complain(m, "the state is no longer finite: a parameter has left its range, "
                            "or the integration step is too long for it");
    return OK;
}

EXPORTED Status fmi2CancelStep(void *c) { return complain(c, "no step runs in the background"); }

EXPORTED Status fmi2GetStatus(void *c, int kind, Status *value)
{
    (void)c, (void)kind;
    *value = OK;
    return DISCARD;
}

EXPORTED Status fmi2GetRealStatus(void *c, int kind, double *value)
{
    State *s = &((Instance *)c)->state;
    if (kind != 2)
        return DISCARD;
    *value = s->start_time + (double)s->steps * STEP;
    return OK;
}

EXPORTED Status fmi2GetIntegerStatus(void *c, int kind, int *value)
{
    (void)c, (void)kind, (void)value;
    return DISCARD;
}

EXPORTED Status fmi2GetBooleanStatus(void *c, int kind, int *value)
{
    (void)c;
    if (kind != 3)
        return DISCARD;
    *value = 0;
    return OK;
}

EXPORTED Status fmi2GetStringStatus(void *c, int kind, const char **value)
{
    (void)c, (void)kind, (void)value;
    return DISCARD;
}

EXPORTED Status fmi2GetFMUstate(void *c, void **state)
{
    if (!*state)
        *state = malloc(sizeof(State));
    if (!*state)
        return complain(c, "no memory for a state");
    memcpy(*state, &((Instance *)c)->state, sizeof(State));
    return OK;
}

EXPORTED Status fmi2SetFMUstate(void *c, void *state)
{
    memcpy(&((Instance *)c)->state, state, sizeof(State));
    return OK;
}

EXPORTED Status fmi2FreeFMUstate(void *c, void **state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORTED Status fmi2SerializedFMUstateSize(void *c, void *state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(State);
    return OK;
}

EXPORTED Status fmi2SerializeFMUstate(void *c, void *state, char bytes[], size_t size)
{
    if (size < sizeof(State))
        return complain(c, "too little room for a state");
    memcpy(bytes, state, sizeof(State));
    return OK;
}

EXPORTED Status fmi2DeSerializeFMUstate(void *c, const char bytes[], size_t size, void **state)
{
    if (size != sizeof(State))
        return complain(c, "a state of another size");
    *state = malloc(sizeof(State));
    if (!*state)
        return complain(c, "no memory for a state");
    memcpy(*state, bytes, sizeof(State));
    return OK;
}

EXPORTED Status fmi2GetDirectionalDerivative(void *c, const unsigned int unknown[], size_t n,
                                             const unsigned int known[], size_t m,
                                             const double seed[], double value[])
{
    (void)unknown, (void)n, (void)known, (void)m, (void)seed, (void)value;
    return complain(c, "this FMU gives no directional derivatives");
}
