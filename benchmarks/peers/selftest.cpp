// Compare every model's Jacobians with central differences, and print the largest errors and, for
// comparison with cases.py, the cost of each problem at its start.

#include "command.hpp"
#include "models.hpp"

#include <random>

template <class Model>
double largest_error(const peers::Case<Model>& c, const std::string& name) {
  constexpr int nx = Model::nx, nu = Model::nu;
  std::mt19937 generator(0);
  std::uniform_real_distribution<double> uniform(0.05, 0.95);
  typename Model::Cache cache;
  double largest = 0;
  for (int trial = 0; trial < 200; ++trial) {
    typename Model::X x = c.start;
    typename Model::U u;
    for (int i = 0; i < nx; ++i) x[i] += 2 * uniform(generator) - 1;
    for (int i = 0; i < nu; ++i) u[i] = uniform(generator);
    if (name[1] == '3') for (int i = 4; i < nx; ++i) x[i] = uniform(generator);
    peers::Matrix<double, nx, nx> a, da;
    peers::Matrix<double, nx, nu> b, db;
    a.setZero(), b.setZero();
    c.model.prepare(a, b);
    c.model.step(x, u, cache);
    c.model.linearize(x, u, cache, a, b);
    const double h = 1e-6;
    typename Model::Cache other;
    for (int i = 0; i < nx; ++i) {
      typename Model::X plus = x, minus = x;
      plus[i] += h, minus[i] -= h;
      da.col(i) = (c.model.step(plus, u, other) - c.model.step(minus, u, other)) / (2 * h);
    }
    for (int i = 0; i < nu; ++i) {
      typename Model::U plus = u, minus = u;
      plus[i] += h, minus[i] -= h;
      db.col(i) = (c.model.step(x, plus, other) - c.model.step(x, minus, other)) / (2 * h);
    }
    const double error = std::max((a - da).cwiseAbs().maxCoeff() / (1 + da.cwiseAbs().maxCoeff()),
                                  (b - db).cwiseAbs().maxCoeff() / (1 + db.cwiseAbs().maxCoeff()));
    largest = std::max(largest, error);
  }
  return largest;
}

int main() {
  double worst = 0;
  for (const std::string name : {"P1", "P2", "P3f", "P3", "P3h", "P4-4", "P4-8"}) {
    peers::with_case(name, [&](const auto& c) {
      using Model = std::decay_t<decltype(c.model)>;
      typename Model::Cache cache;
      auto x = c.start;
      const typename Model::U u = Model::U::Constant(name[1] == '3' ? 0.1 : 0.0);
      for (int k = 0; k < c.steps; ++k) x = c.model.step(x, u, cache);
      const double cost = 0.5 * c.w.dot((x - c.target).cwiseAbs2()) +
                          0.5 * c.model.dt * c.r * c.steps * u.squaredNorm();
      const double error = largest_error(c, name);
      worst = std::max(worst, error);
      std::printf("%-5s largest error of the Jacobians %.1e, cost at the start %.15e\n",
                  name.c_str(), error, cost);
    });
  }
  return worst < 1e-7 ? 0 : 1;
}
