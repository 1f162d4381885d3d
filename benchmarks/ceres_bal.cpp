// Bundle adjustment of a BAL file with Ceres, for bench_bundle.py, which compiles and runs it.
//
//   ceres_bal FILE THREADS (dense|sparse) MAX_ITERATIONS
//
// Prints a line for every iteration: seconds since Solve was called, cost. Cameras and points move freely, without robust loss.

#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

struct Reprojection {
  double u, v;

  template <typename T>
  bool operator()(const T* camera, const T* point, T* residual) const {
    T p[3];
    ceres::AngleAxisRotatePoint(camera, point, p);
    for (int i = 0; i < 3; ++i) p[i] += camera[3 + i];
    const T x = -p[0] / p[2], y = -p[1] / p[2];
    const T r2 = x * x + y * y;
    const T scale = camera[6] * (1.0 + r2 * (camera[7] + camera[8] * r2));
    residual[0] = scale * x - u;
    residual[1] = scale * y - v;
    return true;
  }
};

int main(int argc, char** argv) {
  if (argc != 5) return 2;
  std::FILE* file = std::fopen(argv[1], "r");
  int cameras = 0, points = 0, observations = 0;
  if (!file || std::fscanf(file, "%d %d %d", &cameras, &points, &observations) != 3) return 2;
  std::vector<int> camera_of(observations), point_of(observations);
  std::vector<double> pixels(2 * observations), values(9 * cameras + 3 * points);
  for (int k = 0; k < observations; ++k) {
    if (std::fscanf(file, "%d %d %lf %lf", &camera_of[k], &point_of[k], &pixels[2 * k], &pixels[2 * k + 1]) != 4) return 2;
  }
  for (double& value : values) {
    if (std::fscanf(file, "%lf", &value) != 1) return 2;
  }
  std::fclose(file);

  ceres::Problem problem;
  double* first_point = values.data() + 9 * cameras;
  for (int k = 0; k < observations; ++k) {
    problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Reprojection, 2, 9, 3>(
                                 new Reprojection{pixels[2 * k], pixels[2 * k + 1]}),
                             nullptr, values.data() + 9 * camera_of[k], first_point + 3 * point_of[k]);
  }
  ceres::Solver::Options options;
  options.num_threads = std::atoi(argv[2]);
  options.linear_solver_type = std::string(argv[3]) == "dense" ? ceres::DENSE_SCHUR : ceres::SPARSE_SCHUR;
  options.max_num_iterations = std::atoi(argv[4]);
  options.function_tolerance = 1e-12;
  options.gradient_tolerance = 1e-14;
  options.parameter_tolerance = 1e-14;
  options.logging_type = ceres::SILENT;
  options.linear_solver_ordering.reset(new ceres::ParameterBlockOrdering);
  for (int k = 0; k < points; ++k) options.linear_solver_ordering->AddElementToGroup(first_point + 3 * k, 0);
  for (int k = 0; k < cameras; ++k) options.linear_solver_ordering->AddElementToGroup(values.data() + 9 * k, 1);
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  double lowest = summary.initial_cost;
  for (const auto& iteration : summary.iterations) {
    if (iteration.step_is_successful || iteration.iteration == 0) lowest = iteration.cost;
    std::printf("%.9f %.12e\n", iteration.cumulative_time_in_seconds, lowest);
  }
  return 0;
}
