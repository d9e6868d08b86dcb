-- Wireshark dissector for the captures of busmaster: HCP, HCP2, MicroFlex, MSC, Mentor II, DC104, CT-ANSI; what Modbus
-- frames say is left to Wireshark's own dissector.
--
-- Copy it into the folder that Help > About Wireshark > Folders calls "Personal Lua Plugins", or run
-- tshark -X lua_script:busmaster.lua -r line.pcapng. The folder profile/ beside it has columns for the times of replies
-- and colours for what went wrong: copied as profiles/busmaster into the "Personal configuration" folder, it is chosen
-- by Edit > Configuration Profiles or -C busmaster. Every packet is one frame on the line behind a header (version,
-- protocol, direction, outcome, node; since version 2 the request and the attempt at it, by number), on the private
-- link type 157. A protocol that has no number there is called as the packet's interface is described. Frames are read
-- by position: any byte, a control character too, may be a checksum.

local HEADERS, NO_NODE = { 6, 12 }, 0xFFFF
local STX, ETX, EOT, ENQ, ACK, BEL, BS, NAK = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x15
local FROM_NODE, FROM_HOST = 1, 2
local HCP, HCP2, MICROFLEX, MSC, MENTOR, DC104, MODBUS, CT_ANSI = 1, 2, 3, 4, 5, 6, 7, 8

local TITLES = { [0] = "unknown", "HCP", "HCP2", "MicroFlex", "MSC", "Mentor", "DC104", "Modbus", "CT-ANSI" }
local DIRECTIONS = { [0] = "unknown", "node to host", "host to node" }
local OUTCOMES = {
  [0] = "-", "ok", "no reply", "garbled", "refused", "unexpected", "not believed", "not read", "cut off",
}
local NO_REPLY, UNEXPECTED, AMBIGUOUS = 2, 5, 6
local SHORT_COMMANDS = { [NAK] = "again", [ACK] = "next", [BS] = "previous" }
local ACKNOWLEDGED = { ACK = true, NAK = true, EOT = true }
local ACKNOWLEDGEMENTS = { [ACK] = "ACK", [NAK] = "NAK", [EOT] = "EOT" }

local line = Proto("busmaster", "Serial line of drives")

local f = {
  protocol = ProtoField.uint8("busmaster.protocol", "Protocol", base.DEC, TITLES),
  direction = ProtoField.uint8("busmaster.direction", "Direction", base.DEC, DIRECTIONS),
  outcome = ProtoField.uint8("busmaster.outcome", "Outcome", base.DEC, OUTCOMES),
  node = ProtoField.uint16("busmaster.node", "Node"),
  transaction = ProtoField.uint32("busmaster.transaction", "Request, by number"),
  attempt = ProtoField.uint8("busmaster.attempt", "Attempt at it"),
  joined = ProtoField.bool("busmaster.joined", "In one piece with the end of the frame before"),
  command = ProtoField.string("busmaster.command", "Command"),
  element = ProtoField.uint8("busmaster.element", "Element"),
  parameter = ProtoField.string("busmaster.parameter", "Parameter"),
  address = ProtoField.uint16("busmaster.address", "Data address"),
  flag = ProtoField.uint16("busmaster.flag", "Flag"),
  name = ProtoField.string("busmaster.name", "Name"),
  data = ProtoField.string("busmaster.data", "Data"),
  value = ProtoField.double("busmaster.value", "Value"),
  bits = ProtoField.string("busmaster.bits", "Bits set"),
  acknowledgement = ProtoField.string("busmaster.ack", "Acknowledgement"),
  length = ProtoField.uint16("busmaster.length", "Body length"),
  sequence = ProtoField.uint16("busmaster.sequence", "Block sequence number"),
  leg = ProtoField.string("busmaster.leg", "Leg"),
  checksum = ProtoField.uint16("busmaster.checksum", "Checksum", base.HEX),
  expected = ProtoField.uint16("busmaster.checksum.expected", "Expected", base.HEX),
  status = ProtoField.string("busmaster.checksum.status", "Checksum status"),
  request_in = ProtoField.framenum("busmaster.request_in", "Request in", base.NONE, frametype.REQUEST),
  time = ProtoField.double("busmaster.time", "Seconds since the request"),
  late = ProtoField.bool("busmaster.late", "Came after its request was given up"),
}
line.fields = f

local e = {
  checksum = ProtoExpert.new("busmaster.checksum.bad", "Bad checksum", expert.group.CHECKSUM, expert.severity.ERROR),
  broken = ProtoExpert.new("busmaster.broken", "No frame, or cut short", expert.group.MALFORMED, expert.severity.ERROR),
  refused = ProtoExpert.new("busmaster.nak", "Refused (NAK)", expert.group.RESPONSE_CODE, expert.severity.WARN),
  missing = ProtoExpert.new("busmaster.eot", "No such parameter (EOT)", expert.group.RESPONSE_CODE, expert.severity.WARN),
  silent = ProtoExpert.new("busmaster.silent", "No reply", expert.group.SEQUENCE, expert.severity.WARN),
  echo = ProtoExpert.new("busmaster.echo", "Not what was asked", expert.group.SEQUENCE, expert.severity.WARN),
  unexpected = ProtoExpert.new("busmaster.unexpected", "No request asked for this", expert.group.SEQUENCE, expert.severity.NOTE),
  late = ProtoExpert.new("busmaster.late.note", "A late reply", expert.group.SEQUENCE, expert.severity.WARN),
  unused = ProtoExpert.new("busmaster.unused", "Not taken for an answer", expert.group.SEQUENCE, expert.severity.WARN),
}
line.experts = e

-- Names ------------------------------------------------------------------------------------------------------------

local AXIS = { [0] = "position", "velocity", "mode", "axis_error", "demand", "encoder", "idle", "following_error" }
local CONTROLLER = {
  [220] = "inputs", [222] = "outputs", [232] = "error", [233] = "error_line", [234] = "error_axis", [235] = "running",
  [237] = "line_number", [239] = "firmware",
}
for channel = 0, 7 do CONTROLLER[224 + channel] = "adc" .. channel end
for axis = 0, 7 do
  for offset, name in pairs(AXIS) do CONTROLLER[100 + 15 * axis + offset] = "axis" .. axis .. "." .. name end
end

local DRIVE = {
  [100] = "position", [103] = "axis_error", [107] = "following_error", [108] = "command_word", [109] = "status_word",
  [110] = "drive_error", [111] = "demand_position", [116] = "torque_reference", [117] = "torque_demand",
  [118] = "speed_reference", [119] = "speed_demand", [120] = "speed_measured", [121] = "speed_error",
  [124] = "drive_overload", [125] = "motor_overload", [126] = "bus_voltage", [127] = "current", [128] = "current_u",
  [129] = "current_v", [130] = "hall_state", [131] = "absolute_encoder", [132] = "phase_search_status",
  [220] = "inputs", [222] = "outputs", [224] = "analog_input", [239] = "firmware", [242] = "temperature",
}
local DRIVE_BITS = {
  [108] = { [6] = "cancel", [7] = "enable" },
  [109] = { [3] = "asynchronous_error", [5] = "stop_input", [6] = "hardware_enable", [7] = "enabled" },
}
local STATUS_BITS = {
  [0] = "PROGRAM_RUNNING", "BATTERY_LOW", "RAM_NOT_RELIABLE", "SYSTEM_RESET", "RETURN_INTERRUPT", "FAULT_INTERRUPT",
  "AUTO_START_ENABLED", "SYSTEM_TEST", "LOAD_OVER_RUNNING_PROGRAM", "CHECKSUM_INCORRECT", "LOAD_IN_PROGRESS",
  "LOAD_OUT_OF_SEQUENCE", "BAD_OPCODE", "STACK_OVERFLOW", "STACK_UNDERFLOW", "INTERRUPT_TABLE_FULL",
}

-- A controller and a MicroFlex number their elements differently, and a frame does not say which of them is meant.
local function element_name(protocol, element)
  local controller, drive = CONTROLLER[element], DRIVE[element]
  if protocol == HCP then return nil end
  if protocol == MICROFLEX then return drive end
  if controller and drive and controller:sub(-#drive) ~= drive then return controller .. " / MicroFlex " .. drive end
  return controller or (drive and "MicroFlex " .. drive)
end

local function bit_names(number, names)
  local found = {}
  for bit = 0, 15 do
    if math.floor(number / 2 ^ bit) % 2 == 1 then found[#found + 1] = names[bit] end
  end
  return table.concat(found, "|")
end

-- Checksums --------------------------------------------------------------------------------------------------------

local function xor2(a, b)
  local result, place = 0, 1
  while a > 0 or b > 0 do
    if a % 2 ~= b % 2 then result = result + place end
    a, b, place = math.floor(a / 2), math.floor(b / 2), place * 2
  end
  return result
end

local function xor(frame, first, last, mask)
  local check = 0
  for at = first, last do check = xor2(check, frame(at, 1):uint() % (mask or 256)) end
  return check
end

local function bcc(frame, first, last)
  local check = xor(frame, first, last, 128)
  return check < 0x20 and check + 0x20 or check
end

local function sum(frame, first, last)
  local total = 0
  for at = first, last do total = total + frame(at, 1):uint() end
  return total
end

-- What one packet says; `dissect` fills in the columns from it -------------------------------------------------------

local function hex_of(range)
  local text = range:string()
  return text:match("^[0-9A-F]+$") and tonumber(text, 16)
end

local function decimal_of(range)
  local text = range:string()
  return text:match("^[0-9]+$") and tonumber(text, 10)
end

local function add_checksum(p, range, found, expected)
  local item = p.tree:add(f.checksum, range, found)
  if found == expected then
    item:append_text(" (good)")
    item:add(f.status, range, "good"):set_generated()
    return
  end
  item:append_text(string.format(" (bad, should be 0x%02X)", expected))
  item:add(f.expected, range, expected):set_generated()
  item:add(f.status, range, "bad"):set_generated()
  item:add_proto_expert_info(e.checksum)
  p.bad = true
end

local function add_bits(p, tree, range, number, names)
  local set = bit_names(number, names)
  tree:add(f.bits, range, set):set_generated()
  p.detail = " [" .. set .. "]"
end

-- Where the printable characters from `start` end, or the frame does.
local function field_end(frame, start, mask)
  for at = start, frame:len() - 1 do
    if frame(at, 1):uint() % (mask or 256) < 0x20 then return at end
  end
  return frame:len()
end

local function add_element(p, range, element)
  p.item = element
  local item = p.tree:add(f.element, range, element)
  local name = element_name(p.protocol, element)
  if name then
    item:append_text(" (" .. name .. ")")
    item:add(f.name, range, name):set_generated()
  end
  p.what = "element " .. element .. (name and " (" .. name .. ")" or "")
end

local function add_values(p, range, first)
  local text, at = range:string(), 0
  local item = p.tree:add(f.data, range, text)
  for part in (range:raw() .. ","):gmatch("([^,]*),") do
    local number = tonumber(part)
    if number then
      local value = item:add(f.value, range(at, #part), number)
      if first then
        value:prepend_text("Element " .. first .. " ")
        local names = p.protocol ~= HCP and DRIVE_BITS[first]
        if names then add_bits(p, value, range(at, #part), number, names) end
      end
    end
    at, first = at + #part + 1, first and first + 1
  end
  p.value = text
end

local function telegram(p, frame, start, check, mask)
  local last = frame:len() - 1
  if field_end(frame, start, mask) ~= last - 1 or frame(last - 1, 1):uint() % (mask or 256) ~= ETX then return false end
  if last - 1 > start then add_values(p, frame(start, last - 1 - start), p.protocol < MSC and p.item or nil) end
  add_checksum(p, frame(last, 1), frame(last, 1):uint() % (mask or 256), check)
  return true
end

-- `mask`: where bit 7 of a character may carry parity. Elsewhere it is a bit as any other, and 0x86 is no ACK.
local function acknowledgement(p, frame, mask)
  local text = ACKNOWLEDGEMENTS[frame(0, 1):uint() % (mask or 256)]
  if frame:len() ~= 1 or not text then return false end
  local item = p.tree:add(f.acknowledgement, frame(0, 1), text)
  if text == "NAK" then item:add_proto_expert_info(e.refused) end
  if text == "EOT" then item:add_proto_expert_info(e.missing) end
  p.kind, p.say = text, text
  return true
end

-- HCP and HCP2 -------------------------------------------------------------------------------------------------------

local function comms(p, frame)
  local plain, size, first = p.protocol == HCP, frame:len(), frame(0, 1):uint()
  local number = plain and decimal_of or hex_of
  if p.direction == FROM_NODE then
    if size == 1 then return acknowledgement(p, frame) end
    local element = size >= 5 and first == STX and number(frame(1, 2))
    if not element then return false end
    p.kind = "value"
    add_element(p, frame(1, 2), element)
    return telegram(p, frame, 3, xor(frame, 1, size - 2))
  end
  if size < 7 or first ~= (plain and EOT or BEL) or frame(3, 1):uint() ~= STX then return false end
  local node = hex_of(plain and frame(1, 1) or frame(1, 2))
  local element = number(frame(4, 2))
  if not node or not element or (plain and frame(1, 1):uint() ~= frame(2, 1):uint()) then return false end
  p.node = node
  p.tree:add(f.node, frame(1, 2), node)
  if frame(6, 1):uint() == ENQ then
    if size ~= (plain and 7 or 8) then return false end
    p.kind = "read"
    p.tree:add(f.command, frame(6, 1), "read")
    add_element(p, frame(4, 2), element)
    if not plain then add_checksum(p, frame(7, 1), frame(7, 1):uint(), xor(frame, 1, 6)) end
    return true
  end
  p.kind = "write"
  p.tree:add(f.command, frame(3, 1), "write")
  add_element(p, frame(4, 2), element)
  return telegram(p, frame, 6, xor(frame, plain and 4 or 1, size - 2))
end

-- Mentor II ----------------------------------------------------------------------------------------------------------

local function seven_bits(range)
  local text = ""
  for at = 0, range:len() - 1 do text = text .. string.char(range(at, 1):uint() % 128) end
  return text
end

local function add_parameter(p, range)
  local digits = seven_bits(range)
  if not digits:match("^%d%d%d%d$") then return false end
  p.item = digits:sub(1, 2) .. "." .. digits:sub(3)
  p.what = p.item
  p.tree:add(f.parameter, range, p.item)
  return true
end

-- As `telegram`, for characters whose bit 7 may carry parity.
local function mentor_data(p, frame, start, covered)
  local last = frame:len() - 1
  if field_end(frame, start, 128) ~= last - 1 or frame(last - 1, 1):uint() % 128 ~= ETX then return false end
  if last - 1 > start then
    local range = frame(start, last - 1 - start)
    p.value = seven_bits(range)
    local item = p.tree:add(f.data, range, p.value)
    if tonumber(p.value) then item:add(f.value, range, tonumber(p.value)) end
  end
  add_checksum(p, frame(last, 1), frame(last, 1):uint() % 128, bcc(frame, covered, last - 1))
  return true
end

local function mentor(p, frame)
  local size, first = frame:len(), frame(0, 1):uint() % 128
  if p.direction == FROM_NODE then
    if size == 1 then return acknowledgement(p, frame, 128) end
    p.kind = "value"
    return size >= 7 and first == STX and add_parameter(p, frame(1, 4)) and mentor_data(p, frame, 5, 1)
  end
  if size == 1 then
    p.kind, p.say = "short", SHORT_COMMANDS[first]
    if p.say then p.tree:add(f.command, frame(0, 1), p.say) end
    return p.say ~= nil
  end
  local a, b = seven_bits(frame):match("^\4(%d)%1(%d)%2")
  if not a or size < 10 then return false end
  p.node = tonumber(a .. b)
  p.tree:add(f.node, frame(1, 4), p.node)
  if frame(5, 1):uint() % 128 == STX then
    p.kind = "write"
    p.tree:add(f.command, frame(5, 1), "write")
    return size >= 13 and add_parameter(p, frame(6, 4)) and mentor_data(p, frame, 10, 6)
  end
  p.kind = "read"
  p.tree:add(f.command, frame(9, 1), "read")
  return size == 10 and frame(9, 1):uint() % 128 == ENQ and add_parameter(p, frame(5, 4))
end

-- MSC ----------------------------------------------------------------------------------------------------------------

local function add_integers(p, range)
  local texts = {}
  for at = 0, range:len() - 4, 4 do
    local number = range(at, 4):int()
    p.tree:add(f.value, range(at, 4), number)
    texts[#texts + 1] = tostring(number)
  end
  p.value = #texts > 4 and table.concat(texts, ",", 1, 4) .. ",... (" .. #texts .. ")" or table.concat(texts, ",")
end

local function add_flags(p, range)
  local set = {}
  for flag = 0, 8 * range:len() - 1 do
    if math.floor(range(math.floor(flag / 8), 1):uint() / 2 ^ (flag % 8)) % 2 == 1 then set[#set + 1] = flag end
  end
  p.value = table.concat(set, ",")
  p.tree:add(f.data, range, p.value):prepend_text("Flags on, ")
end

local function address(p, range)
  p.tree:add(f.address, range)
  p.what = tostring(range:uint())
end

local function flag(p, range)
  p.tree:add(f.flag, range)
  p.what = "flag " .. range:uint()
end

-- Per command: what its request and its reply hold, and how long their payloads are.
local OPERATIONS = {
  DREAD = { asks = 2, address, answers = 4, reply = add_integers },
  BREAD = { asks = 2, address, answers = 128, reply = add_integers },
  DWRITE = { asks = 6, address, values = add_integers },
  BWRITE = { asks = 130, address, values = add_integers },
  SFLAG = { asks = 2, flag },
  CFLAG = { asks = 2, flag },
  RFLAG = { asks = 2, flag, answers = 2, reply = function(p, range)
    p.tree:add(f.value, range, range:uint())
    p.value = tostring(range:uint())
  end },
  RFLAGS = { asks = 0, answers = 32, reply = add_flags },
  RQSTAT = { asks = 0, answers = 8, shortest = 2, reply = function(p, range)
    p.value = tostring(range(0, 2):uint())
    add_bits(p, p.tree:add(f.value, range(0, 2), range(0, 2):uint()), range(0, 2), range(0, 2):uint(), STATUS_BITS)
  end },
}

local function msc_payload(p, range, operation)
  if p.direction == FROM_NODE then
    if not operation.reply or not range then return false end
    if range:len() ~= operation.answers and not (operation.shortest and range:len() >= operation.shortest) then
      return false
    end
    operation.reply(p, range)
    return true
  end
  if (range and range:len() or 0) ~= operation.asks then return false end
  if operation.asks > 0 then operation[1](p, range(0, 2)) end
  if operation.values then operation.values(p, range(2)) end
  return true
end

local function msc(p, frame)
  local size = frame:len()
  if size == 1 then
    if p.direction == FROM_HOST then p.leg = "4: the host acknowledges" else p.leg = "2: the controller acknowledges" end
    return acknowledgement(p, frame)
  end
  if size < 8 or frame(0, 1):uint() ~= STX or size ~= 8 + frame(2, 2):uint() then return false end
  p.node = frame(1, 1):uint()
  p.tree:add(f.node, frame(1, 1), p.node)
  p.tree:add(f.length, frame(2, 2))
  p.tree:add(f.sequence, frame(4, 2))
  p.leg = p.direction == FROM_HOST and "1: request" or "3: reply packet"
  local name = size > 8 and frame(6, size - 8):raw():match("^(%u+),") or ""
  p.command, p.item = name, name
  p.kind = p.direction == FROM_HOST and "request" or "value"
  local operation = OPERATIONS[name]
  if operation then
    p.tree:add(f.command, frame(6, #name), name)
    local start = 7 + #name
    local payload = size - 2 > start and frame(start, size - 2 - start) or nil
    if not msc_payload(p, payload, operation) then operation = nil end
  end
  add_checksum(p, frame(size - 2, 2), frame(size - 2, 2):uint(), sum(frame, 1, size - 3))
  return operation ~= nil
end

-- DC104 --------------------------------------------------------------------------------------------------------------

local function dc104(p, frame)
  local size = frame:len()
  if p.direction == FROM_NODE and size == 1 then return acknowledgement(p, frame) end
  if size < 4 or frame(0, 1):uint() ~= STX then return false end
  local at = 1
  if p.direction == FROM_HOST then
    local second = frame(1, 1):uint()
    p.kind = second == 0xAA and size == 4 and "read" or second == 0x55 and size == 6 and "write" or nil
    if not p.kind then return false end
    p.tree:add(f.command, frame(1, 1), p.kind)
    at = 2
  elseif size ~= 5 then
    return false
  end
  p.kind = p.kind or "value"
  p.item = tostring(frame(at, 1):uint())
  p.what = "parameter " .. p.item
  p.tree:add(f.parameter, frame(at, 1), p.item)
  if p.kind ~= "read" then
    p.value = tostring(frame(at + 1, 2):uint())
    p.tree:add(f.value, frame(at + 1, 2), frame(at + 1, 2):uint())
  end
  add_checksum(p, frame(size - 1, 1), frame(size - 1, 1):uint(), sum(frame, 1, size - 2) % 256)
  return true
end

-- Modbus RTU -----------------------------------------------------------------------------------------------------------

local function modbus(p, frame)
  local size = frame:len()
  if size < 4 then return false end
  p.kind = p.direction == FROM_HOST and "request" or "value"
  p.node = frame(0, 1):uint()
  p.what = string.format("function %d", frame(1, 1):uint() % 128)
  if p.direction == FROM_NODE and frame(1, 1):uint() >= 128 then p.what = p.what .. ", refused" end
  return true
end

-- The conversation: which request a reply answers --------------------------------------------------------------------

local READERS = { comms, comms, comms, msc, mentor, dc104, modbus, mentor }
-- The request that waits for an answer; the last one that was given up; and by packet, found as the packets are read in
-- order the first time, the request that it answers and the one that it is too late for.
local asked, given_up, links, late = nil, nil, {}, {}

function line.init()
  asked, given_up, links, late = nil, nil, {}, {}
end

local function request_of(p, pinfo)
  return {
    number = pinfo.number, time = pinfo.rel_ts, item = p.item, what = p.what, node = p.node, kind = p.kind,
    exchange = p.exchange, reader = READERS[p.protocol],
  }
end

-- A short command asks for the parameter of the request before it, or for the one beside that.
local function short_request(p, pinfo)
  local request = request_of(p, pinfo)
  local menu, number = (asked.item or ""):match("^(%d+)%.(%d+)$")
  local step = ({ again = 0, next = 1, previous = -1 })[p.say]
  request.item = menu and string.format("%s.%02d", menu, number + step)
  request.what, request.node, request.kind = request.item, asked.node, "read"
  return request
end

-- Where the master said to which exchange a packet belongs, only a request of the same one is its request; and only a
-- request of the same kind of frames can be: several protocols may share a line.
local function link(p, pinfo, outcome)
  if pinfo.visited then return links[pinfo.number] end
  if asked and (asked.reader ~= READERS[p.protocol] or (p.exchange and asked.exchange ~= p.exchange)) then asked = nil end
  local asks = p.direction == FROM_HOST and p.kind and p.kind ~= "short" and not ACKNOWLEDGED[p.kind]
  if p.direction ~= 0 and not asks then links[pinfo.number] = asked end
  if asks then asked = request_of(p, pinfo) end
  if asked and p.kind == "short" then asked = short_request(p, pinfo) end
  if outcome == NO_REPLY then
    given_up = asked
  elseif p.direction == FROM_NODE and given_up and asked and given_up.node == asked.node then
    given_up = nil -- a node answers in order: it has sent its overdue reply
  end
  return links[pinfo.number]
end

-- Bytes that nobody asked for may be the answer to the last request that was given up, if they could answer it.
local function delay_of(p, pinfo)
  if pinfo.visited then return late[pinfo.number] end
  local answers = p.kind == "value" or ACKNOWLEDGED[p.kind or ""]
  if given_up and answers and given_up.reader == READERS[p.protocol] and (p.item or given_up.item) == given_up.item then
    late[pinfo.number], given_up = given_up, nil
  end
  return late[pinfo.number]
end

local function seconds_since(request, pinfo)
  return math.floor((pinfo.rel_ts - request.time) * 1e6 + 0.5) / 1e6
end

local function add_delay(p, pinfo, request)
  p.node = p.node or request.node
  p.tree:add(f.request_in, request.number):set_generated()
  p.tree:add(f.time, seconds_since(request, pinfo)):set_generated()
  p.tree:add(f.late, true):set_generated()
  p.tree:add_proto_expert_info(e.late, "A late reply to the request in packet " .. request.number)
end

local function add_link(p, pinfo, request)
  p.node = p.node or request.node
  p.tree:add(f.request_in, request.number):set_generated()
  if p.direction ~= FROM_NODE then return end
  p.tree:add(f.time, seconds_since(request, pinfo)):set_generated()
  if p.kind ~= "value" then return end
  if p.item and request.item and p.item ~= request.item then
    p.tree:add_proto_expert_info(e.echo, "Not what was asked: " .. (request.what or request.item))
  end
  p.what = p.what or request.what
end

local function info(p)
  local who = p.node and "node " .. p.node .. " " or ""
  if p.say then return who .. p.say end
  if not p.kind then return who .. "no frame" end
  local verb = p.command or (p.kind ~= "value" and p.kind) or ""
  local text = who .. verb .. (p.what and (verb ~= "" and " " or "") .. p.what or "")
  if p.value then text = text .. " = " .. p.value .. (p.detail or "") end
  return text
end

local function add_outcome(p, outcome, whole, size)
  if size > 0 and not whole then p.tree:add_proto_expert_info(e.broken) end
  if outcome == NO_REPLY then p.tree:add_proto_expert_info(e.silent) end
  if outcome == UNEXPECTED then p.tree:add_proto_expert_info(e.unexpected) end
  if outcome >= AMBIGUOUS then
    p.tree:add_proto_expert_info(e.unused, "Not taken for an answer: " .. (OUTCOMES[outcome] or ""))
  end
  if size == 0 then return (p.node and "node " .. p.node .. " " or "") .. (OUTCOMES[outcome] or "") end
  local text = info(p)
  if not whole then text = text .. " (" .. size .. (size == 1 and " byte)" or " bytes)") end
  return p.bad and text .. " [bad checksum]" or text
end

local has_description, description = pcall(Field.new, "frame.interface_description")

local function title(protocol)
  if protocol ~= 0 then return TITLES[protocol] end
  local described = has_description and description()
  return described and described.value ~= "" and described.value or TITLES[0]
end

function line.dissector(tvb, pinfo, root)
  local header = tvb:len() > 0 and HEADERS[tvb(0, 1):uint()]
  if not header or tvb:len() < header then return 0 end
  local tree = root:add(line, tvb())
  local protocol, direction, outcome = tvb(1, 1):uint(), tvb(2, 1):uint(), tvb(3, 1):uint()
  tree:add(f.protocol, tvb(1, 1))
  tree:add(f.direction, tvb(2, 1))
  tree:add(f.outcome, tvb(3, 1))

  local p = { tree = tree, protocol = protocol, direction = direction }
  if header > 6 and tvb(6, 4):uint() > 0 then
    tree:add(f.transaction, tvb(6, 4))
    tree:add(f.attempt, tvb(10, 1))
    p.exchange = tvb(6, 5):bytes():tohex()
  end
  if header > 6 and tvb(11, 1):uint() > 0 then tree:add(f.joined, tvb(11, 1)) end
  local size, reader = tvb:len() - header, READERS[protocol]
  local whole = size > 0 and reader ~= nil and direction ~= 0 and reader(p, tvb(header):tvb())
  if not whole then p.kind, p.say = nil, nil end
  local in_frame = p.node
  if not in_frame and tvb(4, 2):uint() ~= NO_NODE then p.node = tvb(4, 2):uint() end
  if outcome == UNEXPECTED then
    local request = direction == FROM_NODE and delay_of(p, pinfo)
    if request then add_delay(p, pinfo, request) end
  else
    local request = link(p, pinfo, outcome)
    if request then add_link(p, pinfo, request) end
  end
  if p.node and not in_frame then tree:add(f.node, tvb(4, 2), p.node):set_generated() end
  if p.leg then tree:add(f.leg, p.leg):set_generated() end
  if protocol == MODBUS and size > 0 then
    local found, own = pcall(Dissector.get, "mbrtu")
    if found and own then pcall(own.call, own, tvb(header):tvb(), pinfo, root) end -- it raises on a malformed frame
  end

  local text = add_outcome(p, outcome, whole, size)
  tree:append_text(", " .. (title(protocol) or "") .. ", " .. text)
  pinfo.cols.protocol = title(protocol) or "serial"
  pinfo.cols.info = text
  local node = p.node and "node " .. p.node or "node"
  if direction == FROM_NODE then pinfo.cols.src, pinfo.cols.dst = node, "host" end
  if direction == FROM_HOST then pinfo.cols.src, pinfo.cols.dst = "host", node end
  return tvb:len()
end

DissectorTable.get("wtap_encap"):add((wtap_encaps or wtap).USER10, line)
