// Crocoddyl (C++, 3.x): SolverFDDP where there are no bounds, SolverBoxFDDP where there are.
//
// One thread. The whole cost is multiplied by a factor, because the solvers' regularisation and
// thresholds are absolute numbers that suit costs of the order of one; what is printed is divided
// by it again. A start is given as infeasible, with all states equal to the first one: by trial
// that was at least as fast and as often successful, on every problem, as to roll the controls out
// and give a feasible start. The factors were chosen by trial too, for the least time at the best
// cost. Two more arguments may follow the common ones: the factor, and "feasible" for the other
// start, whose roll-out then counts in the time.

#include "command.hpp"
#include "models.hpp"

#include <crocoddyl/core/action-base.hpp>
#include <crocoddyl/core/optctrl/shooting.hpp>
#include <crocoddyl/core/solvers/box-fddp.hpp>
#include <crocoddyl/core/solvers/fddp.hpp>
#include <crocoddyl/core/states/euclidean.hpp>

#include <memory>

namespace peers {

using Base = crocoddyl::ActionModelAbstractTpl<double>;
using BaseData = crocoddyl::ActionDataAbstractTpl<double>;
using Eigen::VectorXd;
using Input = Eigen::Ref<const VectorXd>;

template <class Model>
struct Data : BaseData {
  template <template <typename> class M>
  explicit Data(M<double>* model) : BaseData(model) {}
  typename Model::Cache cache;
};

// One node: a step of the dynamics and its cost, or the cost of the last state.
template <class Model>
class Action : public Base {
 public:
  static constexpr int nx = Model::nx, nu = Model::nu;
  using X = typename Model::X;
  using U = typename Model::U;

  Action(const Case<Model>& c, double factor, bool last)
      : Base(std::make_shared<crocoddyl::StateVectorTpl<double>>(nx), nu, 0), case_(c),
        factor_(factor), weight_(factor * c.model.dt * c.r), last_(last) {
    if (c.bounded) {
      set_u_lb(VectorXd::Zero(nu));
      set_u_ub(VectorXd::Ones(nu));
    }
  }

  std::shared_ptr<BaseData> createData() override {
    Base* const base = this;
    auto data = std::allocate_shared<Data<Model>>(Eigen::aligned_allocator<Data<Model>>(), base);
    if (last_) {
      data->Lxx = factor_ * VectorXd(case_.w).asDiagonal();
    } else {
      data->Luu = VectorXd::Constant(nu, weight_).asDiagonal();
      case_.model.prepare(data->Fx, data->Fu);
    }
    return data;
  }

  void calc(const std::shared_ptr<BaseData>& data, const Input& x, const Input& u) override {
    auto& d = static_cast<Data<Model>&>(*data);
    const U control = Eigen::Map<const U>(u.data());
    Eigen::Map<X>(d.xnext.data()) =
        case_.model.step(Eigen::Map<const X>(x.data()), control, d.cache);
    d.cost = 0.5 * weight_ * control.squaredNorm();
  }

  void calcDiff(const std::shared_ptr<BaseData>& data, const Input& x, const Input& u) override {
    auto& d = static_cast<Data<Model>&>(*data);
    const U control = Eigen::Map<const U>(u.data());
    case_.model.linearize(Eigen::Map<const X>(x.data()), control, d.cache,
                          Eigen::Map<Matrix<double, nx, nx>>(d.Fx.data()),
                          Eigen::Map<Matrix<double, nx, nu>>(d.Fu.data()));
    Eigen::Map<U>(d.Lu.data()) = weight_ * control;
  }

  void calc(const std::shared_ptr<BaseData>& data, const Input& x) override {
    const X miss = Eigen::Map<const X>(x.data()) - case_.target;
    data->cost = 0.5 * factor_ * case_.w.dot(miss.cwiseAbs2());
    Eigen::Map<X>(data->xnext.data()) = Eigen::Map<const X>(x.data());
  }

  void calcDiff(const std::shared_ptr<BaseData>& data, const Input& x) override {
    const X miss = Eigen::Map<const X>(x.data()) - case_.target;
    Eigen::Map<X>(data->Lx.data()) = factor_ * case_.w.cwiseProduct(miss);
  }

  // The library can convert models to other scalars; nothing here needs that.
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsDouble() const override { return nullptr; }
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsFloat() const override { return nullptr; }

 private:
  const Case<Model>& case_;
  double factor_, weight_;
  bool last_;
};

template <class Model>
void run(const Command& command, const Case<Model>& c, double factor, bool feasible) {
  constexpr int nu = Model::nu;
  const std::size_t size = std::size_t(c.steps) * nu;
  std::vector<double> numbers = command.read(size);
  const std::size_t count = numbers.size() / size;
  std::vector<std::vector<VectorXd>> starts(count, std::vector<VectorXd>(c.steps));
  for (std::size_t i = 0; i < count; ++i)
    for (int k = 0; k < c.steps; ++k)
      starts[i][k] = Eigen::Map<const VectorXd>(numbers.data() + i * size + k * nu, nu);

  const VectorXd x0 = c.start;
  const std::vector<std::shared_ptr<Base>> running(
      c.steps, std::make_shared<Action<Model>>(c, factor, false));
  auto problem = std::make_shared<crocoddyl::ShootingProblemTpl<double>>(
      x0, running, std::make_shared<Action<Model>>(c, factor, true));
  problem->set_nthreads(1);
  std::unique_ptr<crocoddyl::SolverFDDP> solver;
  if (c.bounded) solver = std::make_unique<crocoddyl::SolverBoxFDDP>(problem);
  else solver = std::make_unique<crocoddyl::SolverFDDP>(problem);
  solver->set_th_stop(factor * command.th_stop);

  std::vector<VectorXd> xs(c.steps + 1, x0);
  std::vector<Outcome> outcomes(count);
  command.run(c.bounded ? "Crocoddyl BoxFDDP" : "Crocoddyl FDDP", numbers, outcomes, [&] {
    for (std::size_t i = 0; i < count; ++i) {
      if (feasible) problem->rollout(starts[i], xs);
      solver->solve(xs, starts[i], command.maxiter, feasible);
      const int iterations = std::min(int(solver->get_iter()) + 1, command.maxiter);
      outcomes[i] = {iterations, solver->get_cost() / factor, solver->get_stop() / factor};
      double* out = numbers.data() + i * size;
      for (const VectorXd& u : solver->get_us()) out = std::copy_n(u.data(), nu, out);
    }
  });
}

}  // namespace peers

int main(int argc, char** argv) {
  const peers::Command command(argc, argv);
  const std::string& name = command.problem;
  double factor = name == "P3h" ? 2e3 : name.rfind("P4", 0) == 0 ? 1e4 : 1e2;
  if (argc > 7) factor = std::atof(argv[7]);
  const bool feasible = argc > 8 && argv[8] == std::string("feasible");
  const bool known = peers::with_case(
      name, [&](const auto& c) { peers::run(command, c, factor, feasible); });
  if (known) return 0;
  std::fprintf(stderr, "%s: unknown problem\n", name.c_str());
  return 2;
}
