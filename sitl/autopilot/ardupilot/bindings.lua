-- The bindings of ArduPilot's scripting that our scripts use, with their checks and limits (bindings.desc and
-- lua_bindings.cpp of Copter 4.7). `host` is what the emulator provides; every script gets an environment of its own,
-- as in lua_scripts::create_sandbox, and so does every module that it requires.
-- Not emulated: integers and floats of 32 bits (here they have 64; factors are rounded by the host).

local host = ...

-- boxed uint32_t -------------------------------------------------------------------------------------------------

local U32 = {}
U32.__index = U32
local function box(value)
  return setmetatable({ value = value % 4294967296 }, U32)
end
local function raw(value)
  if getmetatable(value) == U32 then
    return value.value
  end
  assert(math.type(value) == "integer" or (type(value) == "number" and value >= 0), "Unable to coerce to uint32_t")
  return math.floor(value)
end
function U32:toint()
  local value = self.value
  return value >= 2147483648 and value - 4294967296 or value
end
function U32:tofloat()
  return self.value + 0.0
end
U32.__add = function(a, b) return box(raw(a) + raw(b)) end
U32.__sub = function(a, b) return box(raw(a) - raw(b)) end
U32.__mul = function(a, b) return box(raw(a) * raw(b)) end
U32.__div = function(a, b) return box(raw(a) // raw(b)) end
U32.__idiv = U32.__div
U32.__mod = function(a, b) return box(raw(a) % raw(b)) end
U32.__eq = function(a, b) return raw(a) == raw(b) end
U32.__lt = function(a, b) return raw(a) < raw(b) end
U32.__le = function(a, b) return raw(a) <= raw(b) end
U32.__tostring = function(a) return string.format("%d", a.value) end

local function integer(value, low, high, what)
  local number = getmetatable(value) == U32 and value.value or math.tointeger(value)
  if not number or number < low or number > high then
    error(what .. " out of range: " .. tostring(value), 3)
  end
  return number
end

-- motor_factor_table ---------------------------------------------------------------------------------------------

local MOTORS = 12 -- AP_MOTORS_MAX_NUM_MOTORS is 32 in newer builds; 12 in all
local Factors = {}
Factors.__index = Factors
for _, axis in ipairs({ "throttle", "roll", "pitch", "yaw" }) do
  Factors[axis] = function(self, index, value)
    index = integer(index, 0, MOTORS - 1, axis)
    if value == nil then
      return self["_" .. axis][index + 1]
    end
    assert(type(value) == "number", axis .. " needs a number")
    self["_" .. axis][index + 1] = value
  end
end

local function parameter(name)
  assert(type(name) == "string" and host.parameter(name) ~= nil, "no parameter of this name")
  return {
    get = function() return host.parameter(name) end,
    set = function(_, value)
      host.set_parameter(name, value)
      return true
    end,
  }
end

-- queue of received messages, one for all scripts -----------------------------------------------------------------

local queue, queue_size, accepted_ids, ids_free = nil, 0, {}, 0

function host_receive(id, message, channel, time_ms)
  if not queue or not accepted_ids[id] then
    return
  end
  if #queue < queue_size then -- the newest is dropped when it is full
    queue[#queue + 1] = { message, channel, box(time_ms) }
  end
end

local function bindings()
  return {
    millis = function() return box(host.millis()) end,
    micros = function() return box(host.micros()) end,
    uint32_t = function(value) return box(raw(value or 0)) end,
    motor_factor_table = function()
      local zero = {}
      for i = 1, MOTORS do
        zero[i] = 0.0
      end
      local function copy() return { table.unpack(zero) } end
      return setmetatable({ _throttle = copy(), _roll = copy(), _pitch = copy(), _yaw = copy() }, Factors)
    end,
    Parameter = parameter,
    param = {
      get = function(_, name) return host.parameter(name) end,
      set = function(_, name, value) return host.parameter(name) ~= nil and host.set_parameter(name, value) or false end,
      add_table = function(_, key, prefix, count)
        return host.add_table(integer(key, 0, 200, "key"), prefix, integer(count, 1, 63, "count"))
      end,
      add_param = function(_, key, index, name, value)
        return host.add_parameter(integer(key, 0, 200, "key"), integer(index, 1, 63, "index"), name, value)
      end,
    },
    arming = { is_armed = function() return host.armed() end },
    gcs = {
      send_text = function(_, severity, text)
        assert(type(text) == "string", "text")
        host.text(integer(severity, 0, 7, "severity"), text:sub(1, 50))
      end,
    },
    motors = { get_interlock = function() return host.interlock() end },
    SRV_Channels = {
      get_emergency_stop = function() return host.emergency_stop() end,
      find_channel = function(_, number) return host.channel_of(integer(number, 0, 300, "function")) end,
      set_output_pwm_chan_timeout = function(_, channel, pwm, time_ms)
        host.override(
          integer(channel, 0, 31, "channel"), integer(pwm, 0, 65535, "pwm"), integer(time_ms, 0, 65535, "timeout")
        )
      end,
    },
    Motors_dynamic = {
      add_motor = function(_, motor, order)
        return host.add_motor(integer(motor, 0, MOTORS - 1, "motor"), integer(order, 0, MOTORS, "order"))
      end,
      load_factors = function(_, factors)
        assert(getmetatable(factors) == Factors, "motor_factor_table expected")
        local flat = {}
        for motor = 1, MOTORS do
          flat[#flat + 1] = factors._throttle[motor]
          flat[#flat + 1] = factors._roll[motor]
          flat[#flat + 1] = factors._pitch[motor]
          flat[#flat + 1] = factors._yaw[motor]
        end
        host.load_factors(table.unpack(flat))
      end,
      init = function(_, count) return host.init_motors(integer(count, 0, MOTORS, "count")) end,
    },
    mavlink = {
      init = function(_, size, ids)
        queue_size, ids_free = integer(size, 0, 25, "queue size"), integer(ids, 0, 25, "ids")
        queue = queue or {}
      end,
      register_rx_msgid = function(_, id)
        if accepted_ids[id] then
          return false
        end
        assert(ids_free > 0, "no registrations free")
        accepted_ids[id], ids_free = true, ids_free - 1
        return true
      end,
      receive_chan = function()
        assert(queue, "RX not initialized")
        if #queue == 0 then
          return
        end
        return table.unpack(table.remove(queue, 1))
      end,
      send_chan = function(_, channel, id, packet)
        assert(type(packet) == "string", "packet")
        return host.send(integer(channel, 0, 15, "channel"), integer(id, 0, 16777215, "id"), packet)
      end,
    },
  }
end

-- sandboxes and the scheduler -------------------------------------------------------------------------------------

local BASE = {
  "assert", "collectgarbage", "error", "getmetatable", "ipairs", "next", "pairs", "pcall", "print", "rawequal",
  "rawget", "rawlen", "rawset", "select", "setmetatable", "tonumber", "tostring", "type",
}

local function sandbox()
  local env = bindings()
  for _, name in ipairs(BASE) do
    env[name] = _G[name]
  end
  env.math, env.table, env.string = math, table, string
  local loaded = {}
  env.require = function(name)
    if loaded[name] == nil then
      local text = host.module(name)
      if not text then
        error("module '" .. name .. "' not found")
      end
      local module = assert(load(text, "@" .. name, "t", env))()
      loaded[name] = module == nil and true or module
    end
    return loaded[name]
  end
  return env
end

-- Runs `script` once under the instruction limit; returns the next function and its delay, or nil and the error.
function host_run(script, limit)
  local over = false
  local thread = coroutine.create(script) -- with a hook of its own: it must not go on in here
  debug.sethook(thread, function()
    over = true
    debug.sethook(thread, function() error("Exceeded CPU time") end, "", 1)
    error("Exceeded CPU time")
  end, "", limit)
  local good, following, delay = coroutine.resume(thread)
  if not good or over then
    return nil, over and "exceeded time limit" or tostring(following)
  end
  if type(following) ~= "function" or type(delay) ~= "number" then
    return nil, "did not return a function and a delay"
  end
  return following, delay
end

function host_load(text, name)
  return load(text, "@" .. name, "t", sandbox())
end
