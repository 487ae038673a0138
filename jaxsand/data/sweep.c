// The sweep of jaxsand/sweep.py as a plain C loop, for comparison: eight neighbours, one flux a link and side, cut to whole
// quanta, maps in a halo of NaN. A map is swept until no slope exceeds repose by more than `tolerance`, looking every
// `interval` sweeps, or exactly `bound` times where `tolerance` is negative. Build with
//   cc -O3 -march=native -fno-math-errno -fno-trapping-math -fno-signed-zeros -fassociative-math -shared -fPIC
#include <math.h>
#include <stdlib.h>

#define AT(i, j) ((i) * (w + 2) + (j))

static float worst(const float *u, int h, int w, float drop) {
  float top = 0;
  for (int i = 1; i <= h; i++)
    for (int j = 1; j <= w; j++) {
      float x = u[AT(i, j)], e;
#define LOOK(k, m, length) \
  e = (fabsf(u[k] - x) - (m)) * (1 / (length)); \
  top = e > top ? e : top;
      LOOK(AT(i, j + 1), drop, 1.0f)
      LOOK(AT(i + 1, j), drop, 1.0f)
      LOOK(AT(i + 1, j + 1), drop * 1.41421356f, 1.41421356f)
      LOOK(AT(i + 1, j - 1), drop * 1.41421356f, 1.41421356f)
    }
  return top;
}

// The power of two of which heights up to the map's largest hold at most 2^23.
static float grain(const float *u, int h, int w) {
  float top = 0;
  for (int i = 1; i <= h; i++)
    for (int j = 1; j <= w; j++) top = fabsf(u[AT(i, j)]) > top ? fabsf(u[AT(i, j)]) : top;
  int exponent;
  frexpf(top > 1e-30f ? top : 1e-30f, &exponent);
  return ldexpf(1, exponent - 23);
}

// maps [n, h, w] are settled in place; sweeps [n] receives the number of sweeps of each. Returns 0, or 1 without memory.
int settle(float *maps, int n, int h, int w, float spacing, float mu, float rate, float tolerance, int interval, int bound,
           int *sweeps) {
  size_t size = sizeof(float) * (h + 2) * (w + 2);
  float *a = malloc(size), *b = malloc(size);
  if (!a || !b) {
    free(a);
    free(b);
    return 1;
  }
  float drop = mu * spacing, diagonal = drop * 1.41421356f;
  for (int t = 0; t < n; t++) {
    float *map = maps + (size_t)t * h * w;
    for (int k = 0; k < (h + 2) * (w + 2); k++) a[k] = b[k] = NAN;
    for (int i = 0; i < h; i++)
      for (int j = 0; j < w; j++)
        a[AT(i + 1, j + 1)] = map[i * w + j];
    int k = 0;
    while (k < bound) {
      float quantum = grain(a, h, w), c = rate / quantum, d = c / 1.41421356f;
      if (tolerance >= 0 && worst(a, h, w, drop) <= fmaxf(tolerance, 2 * quantum / (rate * spacing)) * spacing) break;
      for (int s = 0; s < interval; s++, k++) {
        for (int i = 1; i <= h; i++)
          for (int j = 1; j <= w; j++) {
            float x = a[AT(i, j)], net = 0, e;
#define FLOW(k, m, c) \
  e = a[k] - x; \
  net += truncf(((e > (m) ? e - (m) : 0) + (e < -(m) ? e + (m) : 0)) * (c));
            FLOW(AT(i, j - 1), drop, c)
            FLOW(AT(i, j + 1), drop, c)
            FLOW(AT(i - 1, j), drop, c)
            FLOW(AT(i + 1, j), drop, c)
            FLOW(AT(i - 1, j - 1), diagonal, d)
            FLOW(AT(i - 1, j + 1), diagonal, d)
            FLOW(AT(i + 1, j - 1), diagonal, d)
            FLOW(AT(i + 1, j + 1), diagonal, d)
            b[AT(i, j)] = x + net * quantum;
          }
        float *swap = a;
        a = b;
        b = swap;
      }
    }
    sweeps[t] = k;
    for (int i = 0; i < h; i++)
      for (int j = 0; j < w; j++) map[i * w + j] = a[AT(i + 1, j + 1)];
  }
  free(a);
  free(b);
  return 0;
}
