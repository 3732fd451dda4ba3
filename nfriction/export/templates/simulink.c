/* Level-2 S-function around {{ name }}.h. Build it together with the controller:
 *     mex {{ name }}_sfun.c {{ name }}.c
 * Inputs: velocity, acceleration and, depending on a load function in {{ name }}.h, joint
 * position or load; outputs: torque, coefficients (joint by joint) and status bits. Runs at the
 * {{ "sample time of the model, because its state advances by one sample in every call" if held else "sample time of the block that drives it" }}.
 */
#define S_FUNCTION_NAME {{ name }}_sfun
#define S_FUNCTION_LEVEL 2

#include "simstruc.h"
#include "{{ name }}.h"

static void mdlInitializeSizes(SimStruct *S)
{
    int port;
    ssSetNumSFcnParams(S, 0);
    if (ssGetNumSFcnParams(S) != ssGetSFcnParamsCount(S))
        return;
    if (!ssSetNumInputPorts(S, 3) || !ssSetNumOutputPorts(S, 3))
        return;
    for (port = 0; port < 3; ++port) {
        ssSetInputPortWidth(S, port, NF_JOINTS);
        ssSetInputPortDataType(S, port, SS_DOUBLE);
        ssSetInputPortDirectFeedThrough(S, port, 1);
        ssSetInputPortRequiredContiguous(S, port, 1);
        ssSetOutputPortDataType(S, port, port == 2 ? SS_INT32 : SS_DOUBLE);
    }
    ssSetOutputPortWidth(S, 0, NF_JOINTS);
    ssSetOutputPortWidth(S, 1, NF_JOINTS * NF_COEFFICIENTS);
    ssSetOutputPortWidth(S, 2, NF_JOINTS);
#if NF_STATE_SIZE
    /* The memory, and whether it has begun. */
    ssSetNumDWork(S, 2);
    ssSetDWorkWidth(S, 0, NF_JOINTS * NF_STATE_SIZE);
    ssSetDWorkDataType(S, 0, SS_DOUBLE);
    ssSetDWorkWidth(S, 1, 1);
    ssSetDWorkDataType(S, 1, SS_INT32);
#endif
    ssSetNumSampleTimes(S, 1);
    ssSetOptions(S, SS_OPTION_EXCEPTION_FREE_CODE);
}

static void mdlInitializeSampleTimes(SimStruct *S)
{
    ssSetSampleTime(S, 0, {{ held or "INHERITED_SAMPLE_TIME" }});
    ssSetOffsetTime(S, 0, 0.0);
}

#if NF_STATE_SIZE
#define MDL_INITIALIZE_CONDITIONS
static void mdlInitializeConditions(SimStruct *S)
{
    *(int32_T *)ssGetDWork(S, 1) = 0;
}
#endif

static void mdlOutputs(SimStruct *S, int_T tid)
{
    nf_real in[3][NF_JOINTS], load[NF_JOINTS], tau[NF_JOINTS];
    nf_real coefficients[NF_JOINTS * NF_COEFFICIENTS];
    int status[NF_JOINTS];
    real_T *tau_out = (real_T *)ssGetOutputPortSignal(S, 0);
    real_T *coefficients_out = (real_T *)ssGetOutputPortSignal(S, 1);
    int32_T *status_out = (int32_T *)ssGetOutputPortSignal(S, 2);
    int port, i;
#if NF_STATE_SIZE
    real_T *memory = (real_T *)ssGetDWork(S, 0);
    int32_T *begun = (int32_T *)ssGetDWork(S, 1);
    nf_state state;
    for (i = 0; i < NF_JOINTS * NF_STATE_SIZE; ++i)
        state.memory[i] = (nf_memory)memory[i];
#endif
    (void)tid;
    for (port = 0; port < 3; ++port) {
        const real_T *signal = (const real_T *)ssGetInputPortSignal(S, port);
        for (i = 0; i < NF_JOINTS; ++i)
            in[port][i] = (nf_real)signal[i];
    }
#if NF_HAS_LOAD
    nf_load(in[2], in[0], load);
#else
    for (i = 0; i < NF_JOINTS; ++i)
        load[i] = in[2][i];
#endif
#if NF_STATE_SIZE
    if (!*begun)
        nf_init(&state, in[0], in[1]);
    *begun = 1;
    nf_step(&state, in[0], in[1], load, tau, coefficients, status);
    for (i = 0; i < NF_JOINTS * NF_STATE_SIZE; ++i)
        memory[i] = (real_T)state.memory[i];
#else
    nf_step(in[0], in[1], load, tau, coefficients, status);
#endif
    for (i = 0; i < NF_JOINTS; ++i) {
        tau_out[i] = (real_T)tau[i];
        status_out[i] = (int32_T)status[i];
    }
    for (i = 0; i < NF_JOINTS * NF_COEFFICIENTS; ++i)
        coefficients_out[i] = (real_T)coefficients[i];
}

static void mdlTerminate(SimStruct *S)
{
    (void)S;
}

#ifdef MATLAB_MEX_FILE
#include "simulink.c"
#else
#include "cg_sfun.h"
#endif
