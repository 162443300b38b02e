static law_real larger(law_real a, law_real b)
{
  return ((b > a) || (b != b)) ? b : a;
}

static law_real smaller(law_real a, law_real b)
{
  return ((b < a) || (b != b)) ? b : a;
}

static uint32_t row_at(uint32_t sample, uint32_t count)
{
  return (sample < count) ? sample : (count - 1U);
}

static void copy(law_real *to, const law_real *from, uint32_t size)
{
  for (uint32_t i = 0U; i < size; ++i) {
    to[i] = from[i];
  }
}

static uint32_t number_beyond(const law_real *values, uint32_t size, law_real most)
{
  uint32_t number = 0U;
  for (uint32_t i = 0U; i < size; ++i) {
    number += ((values[i] <= most) && (values[i] >= -most)) ? 0U : 1U;
  }
  return number;
}

static uint32_t number_not_finite(const law_real *values, uint32_t size)
{
  uint32_t number = 0U;
  for (uint32_t i = 0U; i < size; ++i) {
    number += ((values[i] - values[i]) == (law_real)0) ? 0U : 1U;
  }
  return number;
}

static uint32_t number_changed(const law_real *values, const law_real *before, uint32_t size)
{
  uint32_t number = 0U;
  for (uint32_t i = 0U; i < size; ++i) { /* an infinite one may stay */
    const bool is_finite = (values[i] - values[i]) == (law_real)0;
    number += (is_finite || (values[i] == before[i])) ? 0U : 1U;
  }
  return number;
}

static bool are_within(const law_real *values, uint32_t size, law_real most)
{
  return number_beyond(values, size, most) == 0U;
}

static bool is_unit(const law_real *quaternion)
{
  const law_real square = quaternion[0] * quaternion[0] + quaternion[1] * quaternion[1]
    + quaternion[2] * quaternion[2] + quaternion[3] * quaternion[3];
  return are_within(quaternion, 4U, LAW_LARGEST)
    && ((square - 1) <= LAW_NORM) && ((square - 1) >= -LAW_NORM);
}
