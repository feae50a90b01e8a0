// Times MRPT's COccupancyGridMap2D on the scans of bench/grid_insert.py, for the side-by-side figure.
//
//   mrpt_insert SCANS ROUNDS
//
// SCANS: little endian; int32 scans, int32 beams, double first bearing, double step, double range_max, double cell,
// double half extent; then per scan double x, y, yaw and `beams` float ranges (inf: nothing seen).
// Prints the microseconds of every single insertion of every round after the first, one a line.

#include <mrpt/maps/COccupancyGridMap2D.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/poses/CPose3D.h>

#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <vector>

template <typename T>
static T take(std::ifstream& file)
{
	T value{};
	file.read(reinterpret_cast<char*>(&value), sizeof value);
	return value;
}

int main(int argc, char** argv)
{
	if (argc != 3) return 2;
	std::ifstream file(argv[1], std::ios::binary);
	const int rounds = std::atoi(argv[2]);
	const auto scans = take<int32_t>(file), beams = take<int32_t>(file);
	const auto first = take<double>(file), step = take<double>(file);
	const auto range_max = take<double>(file), cell = take<double>(file), extent = take<double>(file);

	std::vector<mrpt::obs::CObservation2DRangeScan> observations(scans);
	std::vector<mrpt::poses::CPose3D> poses(scans);
	for (int k = 0; k < scans; ++k)
	{
		const auto x = take<double>(file), y = take<double>(file), yaw = take<double>(file);
		poses[k] = mrpt::poses::CPose3D(x, y, 0.0, yaw, 0.0, 0.0);
		auto& scan = observations[k];
		scan.aperture = static_cast<float>(step * (beams - 1));
		scan.rightToLeft = true;
		scan.maxRange = static_cast<float>(range_max);
		scan.sensorPose = mrpt::poses::CPose3D(0, 0, 0, first + step * (beams - 1) / 2, 0, 0);
		scan.resizeScan(beams);
		for (int i = 0; i < beams; ++i)
		{
			const auto range = take<float>(file);
			const bool hit = std::isfinite(range);
			scan.setScanRange(i, hit ? range : static_cast<float>(range_max));
			scan.setScanRangeValidity(i, hit);
		}
	}
	if (!file) return 1;

	mrpt::maps::COccupancyGridMap2D map(-extent, extent, -extent, extent, static_cast<float>(cell));
	map.insertionOptions.maxDistanceInsertion = static_cast<float>(range_max);
	map.insertionOptions.considerInvalidRangesAsFreeSpace = true;
	map.insertionOptions.wideningBeamsWithDistance = false;
	for (int round = 0; round <= rounds; ++round)
		for (int k = 0; k < scans; ++k)
		{
			const auto before = std::chrono::steady_clock::now();
			const bool used = map.insertObservation(observations[k], poses[k]);
			const std::chrono::duration<double, std::micro> spent = std::chrono::steady_clock::now() - before;
			if (!used) return 3;
			if (round > 0) std::printf("%.3f\n", spent.count());
		}
	return 0;
}
