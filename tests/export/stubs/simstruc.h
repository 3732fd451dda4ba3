/* What an S-function needs of Simulink's header, to compile without Simulink. */
#ifndef SIMSTRUC_H
#define SIMSTRUC_H
typedef double real_T;
typedef int int_T;
typedef int int32_T;
typedef struct {
    real_T in[3][64], out[3][64], work[2][64];
} SimStruct;
#define SS_DOUBLE 0
#define SS_INT32 6
#define INHERITED_SAMPLE_TIME (-1.0)
#define SS_OPTION_EXCEPTION_FREE_CODE 1
#define ssSetNumSFcnParams(S, n) ((void)(S))
#define ssGetNumSFcnParams(S) ((void)(S), 0)
#define ssGetSFcnParamsCount(S) ((void)(S), 0)
#define ssSetNumInputPorts(S, n) ((void)(S), 1)
#define ssSetNumOutputPorts(S, n) ((void)(S), 1)
#define ssSetInputPortWidth(S, port, n) ((void)(port))
#define ssSetInputPortDataType(S, port, type) ((void)(port))
#define ssSetInputPortDirectFeedThrough(S, port, yes) ((void)(port))
#define ssSetInputPortRequiredContiguous(S, port, yes) ((void)(port))
#define ssSetOutputPortWidth(S, port, n) ((void)(port))
#define ssSetOutputPortDataType(S, port, type) ((void)(type))
#define ssSetNumDWork(S, n) ((void)(S))
#define ssSetDWorkWidth(S, i, n) ((void)(S))
#define ssSetDWorkDataType(S, i, type) ((void)(S))
#define ssSetNumSampleTimes(S, n) ((void)(S))
#define ssSetSampleTime(S, i, t) ((void)(S))
#define ssSetOffsetTime(S, i, t) ((void)(S))
#define ssSetOptions(S, options) ((void)(S))
#define ssGetInputPortSignal(S, port) ((const void *)(S)->in[port])
#define ssGetOutputPortSignal(S, port) ((void *)(S)->out[port])
#define ssGetDWork(S, i) ((void *)(S)->work[i])
#endif
