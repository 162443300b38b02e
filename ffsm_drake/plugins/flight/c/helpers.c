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

static bool are_within(const law_real *values, uint32_t size, law_real most)
{
  bool are = true;
  for (uint32_t i = 0U; i < size; ++i) {
    are = are && (values[i] <= most) && (values[i] >= -most);
  }
  return are;
}

static bool are_usable(const law_real *values, const law_real *before, uint32_t size)
{
  bool are = true;
  for (uint32_t i = 0U; i < size; ++i) {
    are = are && (((values[i] - values[i]) == (law_real)0) || (values[i] == before[i]));
  }
  return are;
}

static bool is_unit(const law_real *quaternion)
{
  const law_real square = quaternion[0] * quaternion[0] + quaternion[1] * quaternion[1]
    + quaternion[2] * quaternion[2] + quaternion[3] * quaternion[3];
  return are_within(quaternion, 4U, LAW_LARGEST)
    && ((square - 1) <= LAW_NORM) && ((square - 1) >= -LAW_NORM);
}
