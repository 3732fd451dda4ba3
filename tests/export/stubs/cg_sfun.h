/* Simulink includes the S-function's entry points here; the tests call `mdlOutputs` themselves. */
void stub_sizes(SimStruct *S);
void stub_outputs(SimStruct *S);
void stub_sizes(SimStruct *S)
{
    mdlInitializeSizes(S);
    mdlInitializeSampleTimes(S);
#ifdef MDL_INITIALIZE_CONDITIONS
    mdlInitializeConditions(S);
#endif
}
void stub_outputs(SimStruct *S)
{
    mdlOutputs(S, 0);
    mdlTerminate(S);
}
