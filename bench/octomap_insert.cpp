// OctoMap in bench/octree.py: the same clouds, the same resolution, timed by itself.
//
//   octomap_insert FILE
//   FILE: int32 clouds, queries; double resolution; per cloud double origin[3], int32 n, float xyz[n][3];
//         float query[queries][3]
// Prints, one a line, in nanoseconds of processor time: a point of insertPointCloud as it comes, the same with lazy
// evaluation and one ray a voxel (its fastest settings), a query; bytes of memory, leaves, bytes written; then the
// log-odds of each query, "nan" unknown.

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <ctime>
#include <sstream>
#include <vector>

#include <octomap/octomap.h>

namespace {

template <typename T>
T read_one(FILE* file) {
  T value;
  if (fread(&value, sizeof value, 1, file) != 1) throw std::runtime_error("the file is too short");
  return value;
}

octomap::point3d read_point(FILE* file) {
  const float x = read_one<float>(file), y = read_one<float>(file), z = read_one<float>(file);
  return {x, y, z};
}

double now_ns() {  // processor time of this process
  timespec t{};
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return 1e9 * static_cast<double>(t.tv_sec) + static_cast<double>(t.tv_nsec);
}

double since(double start) { return now_ns() - start; }

struct Cloud {
  octomap::point3d origin;
  octomap::Pointcloud points;
};

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  FILE* file = fopen(argv[1], "rb");
  if (file == nullptr) return 2;
  const auto n_clouds = read_one<int32_t>(file);
  const auto n_queries = read_one<int32_t>(file);
  const auto resolution = read_one<double>(file);
  std::vector<Cloud> clouds(n_clouds);
  double points = 0;
  for (auto& cloud : clouds) {
    const double x = read_one<double>(file), y = read_one<double>(file), z = read_one<double>(file);
    cloud.origin = octomap::point3d(x, y, z);
    const auto n = read_one<int32_t>(file);
    for (int i = 0; i < n; ++i) cloud.points.push_back(read_point(file));
    points += n;
  }
  std::vector<octomap::point3d> queries;
  for (int i = 0; i < n_queries; ++i) queries.push_back(read_point(file));

  octomap::OcTree fast(resolution);
  double start = now_ns();
  for (const auto& cloud : clouds) fast.insertPointCloud(cloud.points, cloud.origin, -1.0, true, true);
  fast.updateInnerOccupancy();
  fast.prune();
  const double lazy_ns = since(start) / points;
  fast.clear();

  octomap::OcTree tree(resolution);
  tree.setClampingThresMin(1.0 / (1.0 + std::exp(2.0)));
  tree.setClampingThresMax(1.0 / (1.0 + std::exp(-3.5)));
  tree.setProbHit(1.0 / (1.0 + std::exp(-0.85)));
  tree.setProbMiss(1.0 / (1.0 + std::exp(0.4)));
  start = now_ns();
  for (const auto& cloud : clouds) tree.insertPointCloud(cloud.points, cloud.origin);
  const double plain_ns = since(start) / points;
  tree.prune();

  start = now_ns();
  size_t found = 0;
  for (const auto& point : queries) found += tree.search(point) != nullptr;
  const double query_ns = since(start) / std::max<size_t>(queries.size(), 1);

  std::ostringstream out;
  tree.write(out);
  printf("%.1f\n%.1f\n%.1f\n%zu\n%zu\n%zu\n", plain_ns, lazy_ns, query_ns, tree.memoryUsage(), tree.getNumLeafNodes(),
         out.str().size());
  for (const auto& point : queries) {
    const octomap::OcTreeNode* node = tree.search(point);
    if (node == nullptr) {
      puts("nan");
    } else {
      printf("%.3f\n", node->getLogOdds());
    }
  }
  return found == SIZE_MAX;  // never; it keeps the loop above from being left out
}
