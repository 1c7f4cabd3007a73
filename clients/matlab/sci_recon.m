function [frames, job] = sci_recon(masks, measurement, varargin)
%SCI_RECON  Reconstructs video from a snapshot compressive measurement with a sci-recon service.
%
%   FRAMES = SCI_RECON(MASKS, MEASUREMENT) sends MASKS [H,W,B] on [0,1] and MEASUREMENT [H,W], or [H,W,S] for a
%   sequence of snapshots, waits for the job, and returns FRAMES [H,W,B], or [H,W,B,S], single. The measurement is the
%   sum of the masked frames: its values reach B where all masks are open.
%
%   FRAMES = SCI_RECON(ID) returns the frames of an existing job, such as one that was submitted in the dashboard. It
%   waits for a job that has not ended.
%
%   [FRAMES, JOB] = ... also returns the service's description of the job. Its verdict on the frames is JOB.verdict in a
%   word, and JOB.verdict_text in a line, which is printed. Findings of the checks are warnings with the identifier
%   sci_recon:CODE and the remedy.
%
%   SCI_RECON(..., NAME, VALUE, ...). For an existing job, only 'url', 'token' and 'quiet' matter:
%     'url'         address of the service   (default: environment SCI_RECON_URL, or http://127.0.0.1:8080)
%     'token'       access token             (default: environment SCI_RECON_TOKEN)
%     'algorithm'   'pnp-tv-fastdvdnet' (default), 'gap-tv', 'gap-tv3d', ...
%     'full_scale'  the number in MEASUREMENT that means 1 (default 1; never guessed)
%     'masks_full_scale'  the number in MASKS that means 1
%     'mosaic'      'rggb', 'bggr', 'grbg' or 'gbrg' for a colour sensor: FRAMES are [H,W,3,B], or [H,W,3,B,S], then
%     'dark'        captures of the dark [H,W] or [H,W,N], whose average is subtracted from the measurement
%     'saturation'  the smallest number in MEASUREMENT of a saturated pixel
%     'bad_pixels'  a map [H,W] that is not 0 at bad pixels
%     'dispersion'  a struct for a spectral camera with one mask: axis, offsets, wavelengths, mask
%     'camera_fps', 'exposure_s', 'sequence'   times of the camera; 'contiguous' or 'separate'
%     'masks_name', 'name', 'label'   names of calibration, measurement and job
%     'snapshots'   'all' (default), an index from 0, or [first last]
%     'schedule'    a struct that replaces the algorithm's default schedule
%     'tile'        [size overlap] in pixels
%     'registration'  'auto' (default), 'off', or the shift [rows columns] of the masks in pixels
%     'model'       the network of 'learned'
%     'truth'       true frames [H,W,B] or [H,W,B,S]; the dashboard shows PSNR and SSIM
%     'priority', 'webhook'   order in the queue, and an address that is notified at the end
%     'quiet'       true: print no progress
%
%   Uploads and downloads resume after a lost connection. Errors have the service's code as identifier, such as
%   sci_recon:invalid_content. Needs curl on the path, which Windows 10, macOS and Linux include, and MATLAB R2016b or
%   Octave 7.
%
%   Example:
%     masks = single(rand(256, 256, 8) > 0.5);
%     frames = sci_recon(masks, sum(masks .* video, 3), 'url', 'http://server.lab:8080', 'algorithm', 'gap-tv');

  if ischar(masks) || isa(masks, 'string')
    masks = char(masks);
    flags = varargin;
    if nargin > 1
      flags = [{measurement} varargin];
    end
    o = options(flags);
    [frames, job] = collect(o, request(o, 'GET', ['/v1/jobs/' masks], []));
    return
  end
  o = options(varargin);
  if ndims(masks) > 3 || ndims(measurement) > 3
    error('sci_recon:size', 'masks are [H,W,B] and the measurement is [H,W] or [H,W,S]');
  end
  if size(masks, 1) ~= size(measurement, 1) || size(masks, 2) ~= size(measurement, 2)
    error('sci_recon:size', 'masks are %dx%d, the measurement is %dx%d', ...
          size(masks, 1), size(masks, 2), size(measurement, 1), size(measurement, 2));
  end

  calibration = request(o, 'POST', '/v1/calibrations', ...
                        given(struct('masks', upload(o, masks), 'full_scale', o.masks_full_scale, ...
                                     'mosaic', o.mosaic, 'dispersion', o.dispersion, 'name', o.masks_name, ...
                                     'bad_pixels', upload(o, o.bad_pixels))));
  calibration = ready(o, '/v1/calibrations/', calibration);
  body = given(struct('calibration', calibration.id, 'data', upload(o, measurement), 'full_scale', o.full_scale, ...
                      'saturation', o.saturation, 'camera_fps', o.camera_fps, 'exposure_s', o.exposure_s, ...
                      'sequence', o.sequence, 'name', o.name));
  if ~isempty(o.dark)
    body.dark = {upload(o, o.dark)};
  end
  taken = ready(o, '/v1/measurements/', request(o, 'POST', '/v1/measurements', body));

  if isnumeric(o.registration) && ~isempty(o.registration)
    o.registration = struct('shift', o.registration);
  end
  if ~isempty(o.tile)
    o.tile = struct('size', o.tile(1), 'overlap', o.tile(2));
  end
  truth = upload(o, reshape(o.truth, size(o.truth, 1), size(o.truth, 2), []));
  job = request(o, 'POST', '/v1/jobs', ...
                given(struct('measurement', taken.id, 'algorithm', o.algorithm, 'schedule', o.schedule, ...
                             'snapshots', o.snapshots, 'tile', o.tile, 'model', o.model, ...
                             'registration', o.registration, 'sequence', o.sequence, 'truth', truth, ...
                             'priority', o.priority, 'label', o.label, 'webhook', o.webhook)));
  [frames, job] = collect(o, job);
end

function codes = warn(findings, codes)
  % Issues findings as warnings, except those with a code in `codes`; returns all codes.
  for k = 1:numel(findings)
    found = element(findings, k);
    if ~any(strcmp(found.code, codes))
      warning(['sci_recon:' found.code], '%s. What to do: %s.', found.detail, found.remedy);
    end
  end
  for k = 1:numel(findings)
    found = element(findings, k);
    codes{end + 1} = found.code;
  end
end

function [frames, job] = collect(o, job)
  % Waits until a job has ended, and downloads its frames.
  codes = warn(job.warnings, {});
  shown = -1;
  delay = 0.2;
  while any(strcmp(job.state, {'queued', 'running', 'cancelling'}))
    pause(delay);
    delay = min(2 * delay, 5);
    job = request(o, 'GET', ['/v1/jobs/' job.id], []);
    if ~o.quiet && floor(job.progress.percent) > shown
      shown = floor(job.progress.percent);
      fprintf('%s: %d %%\n', job.state, shown);
    end
  end
  if ~strcmp(job.state, 'succeeded')
    error(['sci_recon:' job.state], 'job %s (%s): %s', job.id, job.state, char(job.error));
  end
  if isstruct(job.assessment)
    warn(job.assessment.reasons, codes);
  end
  if ~o.quiet
    fprintf('%s\n', job.verdict_text);
  end

  frames = [];
  for s = job.snapshots.first + (0:job.snapshots.count - 1)
    % Colour frames have one more axis.
    frames = cat(4 + ~isempty(job.shape.mosaic), frames, download(o, sprintf('/v1/jobs/%s/snapshots/%d', job.id, s)));
  end
end

function o = options(flags)
  o = struct('url', getenv('SCI_RECON_URL'), 'token', getenv('SCI_RECON_TOKEN'), ...
             'algorithm', 'pnp-tv-fastdvdnet', 'full_scale', 1, 'masks_full_scale', 1, 'dark', [], ...
             'saturation', [], 'bad_pixels', [], 'mosaic', [], 'dispersion', [], 'camera_fps', [], ...
             'exposure_s', [], 'sequence', [], 'masks_name', [], 'name', [], 'label', [], 'snapshots', [], ...
             'schedule', [], 'tile', [], 'registration', [], 'model', [], 'truth', [], 'priority', [], ...
             'webhook', [], 'quiet', false);
  for k = 1:2:numel(flags)
    if k == numel(flags) || ~ischar(flags{k}) || ~isfield(o, flags{k})
      error('sci_recon:option', 'options are pairs of a name and a value; the names are %s', ...
            strjoin(fieldnames(o)', ', '));
    end
    o.(flags{k}) = flags{k + 1};
  end
  if isempty(o.url)
    o.url = 'http://127.0.0.1:8080';
  end
  o.url = regexprep(o.url, '/+$', '');
end

function body = given(body)
  % Removes options without a value.
  for name = fieldnames(body)'
    if isempty(body.(name{1}))
      body = rmfield(body, name{1});
    end
  end
end

function record = ready(o, path, record)
  % Waits until the service has checked a calibration or measurement.
  while isfield(record, 'state') && strcmp(record.state, 'preparing')
    pause(0.5);
    record = request(o, 'GET', [path record.id], []);
  end
  if isfield(record, 'state') && strcmp(record.state, 'failed')
    code = 'failed';
    if isfield(record, 'problem') && isstruct(record.problem)
      code = record.problem.code;
    end
    error(['sci_recon:' code], '%s', char(record.error));
  end
end

function one = element(list, k)
  % JSON lists of objects are arrays of structs, or cells where their fields differ.
  if iscell(list)
    one = list{k};
  else
    one = list(k);
  end
end

function record = request(o, method, path, body)
  % Sends a JSON request, and repeats it after a lost connection or while the service is busy. The key makes
  % repeated requests harmless.
  files = {tempname(), tempname()};
  clean = onCleanup(@() remove(files));
  extra = '';
  if ~isempty(body)
    write(files{1}, uint8(unicode2native(jsonencode(body), 'UTF-8')));
    extra = sprintf(' -H "Content-Type: application/json" -H "Idempotency-Key: %s" --data-binary "@%s"', ...
                    key(), files{1});
  end
  for attempt = 1:12
    status = curl(o, sprintf('-X %s%s -o "%s"', method, extra, files{2}), path);
    if status >= 200 && status < 300
      record = jsondecode(native2unicode(read(files{2}), 'UTF-8'));
      return
    end
    if ~any(status == [0 408 423 429 502 503 504])
      break
    end
    pause(min(0.1 * 2 ^ attempt, 30));
  end
  refuse(o, status, files{2}, [method ' ' path]);
end

function refuse(o, status, file, what)
  if status == 0
    error('sci_recon:unreachable', '%s%s does not answer', o.url, what);
  end
  try
    problem = jsondecode(native2unicode(read(file), 'UTF-8'));
    code = problem.code;
    detail = problem.detail;
  catch
    code = sprintf('status_%d', status);
    detail = native2unicode(read(file), 'UTF-8');
  end
  error(['sci_recon:' code], '%s: %d %s', what, status, detail);
end

function hash = upload(o, values)
  % Uploads an array with tus 1.0 in pieces, and resumes after a lost connection. An empty array has no hash.
  hash = '';
  if isempty(values)
    return
  end
  file = tempname();
  answer = tempname();
  clean = onCleanup(@() remove({file, answer, [file '.piece'], [file '.head']}));
  write_npy(file, values);
  listed = dir(file);
  total = listed.bytes;
  piece = 8 * 2 ^ 20;
  location = '';
  failures = 0;
  offset = 0;
  while isempty(hash)
    if isempty(location)
      status = curl(o, sprintf('-X POST -H "Tus-Resumable: 1.0.0" -H "Upload-Length: %d" -D "%s.head" -o "%s"', ...
                               total, file, answer), '/v1/uploads');
      location = ['/v1/uploads/' regexprep(header([file '.head'], 'Location'), '^.*/', '')];
    elseif failures > 0 || offset >= total
      status = curl(o, sprintf('-I -H "Tus-Resumable: 1.0.0" -D "%s.head" -o "%s"', file, answer), location);
      if any(status == [404 410])
        location = '';
        offset = 0;
      elseif status == 200
        before = offset;
        offset = str2double(header([file '.head'], 'Upload-Offset'));
        hash = regexprep(header([file '.head'], 'Content-Location'), '^.*/', '');
        if offset > before
          failures = 0;
        end
        if offset == total && isempty(hash)
          status = 503;
        elseif offset < total
          status = append(o, file, offset, piece, location, answer);
        end
      end
    else
      status = append(o, file, offset, piece, location, answer);
    end
    if status >= 200 && status < 300
      if status == 204
        offset = str2double(header([file '.head'], 'Upload-Offset'));
        failures = 0;
      end
    elseif failures == 12 || ~any(status == [0 404 408 409 410 423 429 502 503 504])
      refuse(o, status, answer, 'upload');
    else
      failures = failures + 1;
      pause(min(0.1 * 2 ^ failures, 30));
    end
  end
end

function status = append(o, file, offset, piece, location, answer)
  id = fopen(file, 'r');
  fseek(id, offset, 'bof');
  bytes = fread(id, piece, '*uint8');
  fclose(id);
  write([file '.piece'], bytes);
  status = curl(o, sprintf(['-X PATCH -H "Tus-Resumable: 1.0.0" -H "Upload-Offset: %d" -D "%s.head" -o "%s" ' ...
                            '-H "Content-Type: application/offset+octet-stream" --data-binary "@%s.piece"'], ...
                           offset, file, answer, file), location);
end

function frames = download(o, path)
  % Downloads the frames of a snapshot, [H,W,B] or [H,W,3,B], and resumes after a lost connection.
  file = tempname();
  clean = onCleanup(@() remove({file}));
  for attempt = 1:12
    status = curl(o, sprintf('-C - -o "%s"', file), [path '/exports/npy']);
    if any(status == [200 206])
      break
    end
    if attempt == 12 || ~any(status == [0 408 429 502 503 504])
      refuse(o, status, file, [path '/exports/npy']);
    end
    pause(min(0.1 * 2 ^ attempt, 30));
  end
  frames = read_npy(file);
end

function status = curl(o, flags, path)
  % Returns the HTTP status, or 0 if the answer was interrupted. The token is passed in a file, because other users
  % of the machine can see command lines.
  config = tempname();
  clean = onCleanup(@() remove({config}));
  lines = '';
  if ~isempty(o.token)
    lines = sprintf('header = "Authorization: Bearer %s"\n', o.token);
  end
  write(config, uint8(lines));
  code = '%{http_code}';
  if ispc
    code = '%%{http_code}';
  end
  command = ['curl -sS -K "' config '" --connect-timeout 10 -w "' code '" ' flags ' "' o.url path '"'];
  [failed, text] = system([command ' 2>&1']);
  status = str2double(regexprep(strtrim(text), '^.*?(\d{3})$', '$1'));
  if failed ~= 0 || isnan(status)
    status = 0;
  end
end

function value = header(file, name)
  value = '';
  if exist(file, 'file')
    found = regexpi(char(read(file)), ['^' name ':[ \t]*([^\r\n]*)'], 'tokens', 'lineanchors');
    if ~isempty(found)
      value = strtrim(found{end}{1});
    end
  end
end

function write_npy(file, values)
  % [H,W,B] becomes [B,H,W] in C order, which has the same byte order as [W,H,B] in MATLAB.
  if islogical(values)
    type = '|b1'; class_name = 'uint8';
  else
    types = struct('single', '<f4', 'double', '<f8', 'uint8', '|u1', 'uint16', '<u2');
    if ~isfield(types, class(values))
      error('sci_recon:class', 'arrays are single, double, uint8, uint16 or logical, not %s', class(values));
    end
    type = types.(class(values)); class_name = class(values);
  end
  shape = sprintf('(%d, %d, %d)', size(values, 3), size(values, 1), size(values, 2));
  text = sprintf('{''descr'': ''%s'', ''fortran_order'': False, ''shape'': %s, }', type, shape);
  text = [text repmat(' ', 1, mod(-(numel(text) + 11), 64)) sprintf('\n')];
  id = fopen(file, 'w', 'ieee-le');
  fwrite(id, [uint8(147) uint8('NUMPY') 1 0], 'uint8');
  fwrite(id, numel(text), 'uint16');
  fwrite(id, text, 'char*1');
  fwrite(id, permute(values, [2 1 3]), class_name);
  fclose(id);
end

function values = read_npy(file)
  % float32 [B,H,W], or [B,H,W,3] of colours, in C order, as the service writes it.
  id = fopen(file, 'r', 'ieee-le');
  start = fread(id, 8, '*uint8');
  if numel(start) < 8 || start(1) ~= 147
    fclose(id);
    error('sci_recon:answer', 'the frames are no npy file');
  end
  text = fread(id, fread(id, 1, 'uint16'), '*char')';
  sides = regexp(text, '\(([^)]*)\)', 'tokens', 'once');
  shape = str2double(regexp(sides{1}, '\d+', 'match'));
  values = reshape(fread(id, prod(shape), '*single'), fliplr(shape));
  if numel(shape) == 4
    values = permute(values, [3 2 1 4]);
  else
    values = permute(values, [2 1 3]);
  end
  fclose(id);
end

function text = key()
  text = sprintf('%s-%s', datestr(now, 'yyyymmddHHMMSSFFF'), char('a' + floor(26 * rand(1, 16))));
end

function write(file, bytes)
  id = fopen(file, 'w');
  fwrite(id, bytes, 'uint8');
  fclose(id);
end

function bytes = read(file)
  bytes = uint8([]);
  if exist(file, 'file')
    id = fopen(file, 'r');
    bytes = fread(id, Inf, '*uint8')';
    fclose(id);
  end
end

function remove(files)
  for k = 1:numel(files)
    if exist(files{k}, 'file')
      delete(files{k});
    end
  end
end
