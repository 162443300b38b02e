static void sine_and_cosine(law_real angle, law_real *both)
{
  /* The angle less k pi / 2 is x + y; then polynomials between -pi / 4 and pi / 4. The constants
     are those of fdlibm (Sun Microsystems, 1993; freely usable). Beyond a million radians: NAN. */
  const law_real k = (angle * 6.36619772367581382433e-01 + 6755399441055744.0)
    - 6755399441055744.0;
  const law_real first = angle - k * 1.57079632673412561417e+00;
  const law_real middle = k * 6.07710050630396597660e-11;
  const law_real second = first - middle;
  const law_real rest = k * 2.02226624879595063154e-21 - ((first - second) - middle);
  const law_real x = second - rest;
  const law_real y = (second - x) - rest;
  const law_real z = x * x;
  const law_real cube = z * x;
  const law_real odd = (((1.58969099521155010221e-10 * z - 2.50507602534068634195e-08) * z
    + 2.75573137070700676789e-06) * z - 1.98412698298579493134e-04) * z
    + 8.33333333332248946124e-03;
  const law_real even = ((((-1.13596475577881948265e-11 * z + 2.08757232129817482790e-09) * z
    - 2.75573143513906633035e-07) * z + 2.48015872894767294178e-05) * z
    - 1.38888888888741095749e-03) * z + 4.16666666666666019037e-02;
  const law_real inner = z * (0.5 * y - cube * odd) - y;
  const law_real s = x - (inner - cube * -1.66666666666666324348e-01);
  const law_real half = 0.5 * z;
  const law_real w = 1.0 - half;
  const law_real tail = (z * z) * even - x * y;
  const law_real c = w + (((1.0 - w) - half) + tail);
  const law_real quadrant = k - 4.0 * floor(k * 0.25);
  const bool is_odd = (quadrant == 1.0) || (quadrant == 3.0);
  const bool is_left = (quadrant == 1.0) || (quadrant == 2.0);
  const bool is_near = angle * angle < 1000000000000.0;
  const law_real sine = is_odd ? c : s;
  const law_real cosine = is_odd ? s : c;
  both[0] = is_near ? ((quadrant >= 2.0) ? -sine : sine) : NAN;
  both[1] = is_near ? (is_left ? -cosine : cosine) : NAN;
}
