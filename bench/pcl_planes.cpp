// Runs PCL's plane-finding region growing on one cloud, for the side-by-side figures of bench/planes.py.
//
//   pcl_planes POINTS LABELS ROUNDS NEIGHBOURS SMOOTHNESS_DEG CURVATURE SMALLEST
//
// POINTS: little endian; int32 count, then float x, y, z each.  LABELS: int32 each, -1 none, is written.
// Prints the milliseconds of every round (normals, growing), one a line.

#include <pcl/features/normal_3d_omp.h>
#include <pcl/point_types.h>
#include <pcl/search/kdtree.h>
#include <pcl/segmentation/region_growing.h>

#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <vector>

int main(int argc, char** argv)
{
	if (argc != 8) return 2;
	std::ifstream file(argv[1], std::ios::binary);
	int32_t count = 0;
	file.read(reinterpret_cast<char*>(&count), sizeof count);
	std::vector<float> numbers(3 * static_cast<size_t>(count));
	file.read(reinterpret_cast<char*>(numbers.data()), numbers.size() * sizeof(float));
	if (!file) return 1;
	pcl::PointCloud<pcl::PointXYZ>::Ptr cloud(new pcl::PointCloud<pcl::PointXYZ>);
	for (int k = 0; k < count; ++k)
		cloud->push_back(pcl::PointXYZ(numbers[3 * k], numbers[3 * k + 1], numbers[3 * k + 2]));

	const int rounds = std::atoi(argv[3]), neighbours = std::atoi(argv[4]), smallest = std::atoi(argv[7]);
	const double smoothness = std::atof(argv[5]) / 180.0 * M_PI, curvature = std::atof(argv[6]);
	std::vector<pcl::PointIndices> clusters;
	for (int round = 0; round < rounds; ++round)
	{
		const auto before = std::chrono::steady_clock::now();
		pcl::search::Search<pcl::PointXYZ>::Ptr tree(new pcl::search::KdTree<pcl::PointXYZ>);
		pcl::PointCloud<pcl::Normal>::Ptr normals(new pcl::PointCloud<pcl::Normal>);
		pcl::NormalEstimationOMP<pcl::PointXYZ, pcl::Normal> estimator;
		estimator.setNumberOfThreads(2);
		estimator.setSearchMethod(tree);
		estimator.setInputCloud(cloud);
		estimator.setKSearch(neighbours);
		estimator.compute(*normals);
		pcl::RegionGrowing<pcl::PointXYZ, pcl::Normal> growing;
		growing.setMinClusterSize(smallest);
		growing.setMaxClusterSize(100000000);
		growing.setSearchMethod(tree);
		growing.setNumberOfNeighbours(neighbours);
		growing.setInputCloud(cloud);
		growing.setInputNormals(normals);
		growing.setSmoothnessThreshold(static_cast<float>(smoothness));
		growing.setCurvatureThreshold(static_cast<float>(curvature));
		growing.extract(clusters);
		const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - before;
		std::printf("%.3f\n", took.count());
	}
	std::vector<int32_t> label(count, -1);
	for (size_t c = 0; c < clusters.size(); ++c)
		for (const auto i : clusters[c].indices) label[i] = static_cast<int32_t>(c);
	std::ofstream(argv[2], std::ios::binary).write(reinterpret_cast<const char*>(label.data()), count * sizeof(int32_t));
	return 0;
}
