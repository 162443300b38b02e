extern const law_gains LAW_GAINS; /* as in the scenario */

/* Set the memory to that before the first sample. */
void law_start(law_state *state);

/* One control sample. A bad one leaves the law's memory as it was; the good one after it is a first
   sample. A bad result within LAW_SETTLED samples of another bad sample, or of the start, begins the
   memory anew, which may be what makes results bad. `in` and `out` may not overlap. */
law_status law_step(const law_in *in, const law_gains *gains, law_state *state, law_out *out);

#if LAW_HAS_REFERENCE
/* Set q_d, v_d, a_d, the frame's path if the law reads it, and the number of the sample. */
void law_reference(uint32_t sample, law_in *in);
#endif

/* The mass matrix of the nominal model. */
