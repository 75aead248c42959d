from highway_env.vehicle.kinematics import Vehicle


def guess(road, position, action):
    car = Vehicle(road, position)
    car.act(action)
    for _ in range(15):
        car.step(1 / 15)
    return car.position
